"""Changes of a model by an effect: keys of the simulator's ``model`` and ``force``.

Both are keyword arguments of a simulator's function, {change: phi}, with phi of shape
(n, k). A change of the model is a :class:`ModelChange`; a generalized force is a
:class:`Force`. They are hashed by what they say, and go to other processes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from typing_extensions import override

from sbi_active.arrays import Array


class ModelChange(ABC):
    """Writes fields of ``mjModel`` for one set of numbers, after the parameters.

    Subclasses are frozen dataclasses.
    """

    @abstractmethod
    def fields(self) -> tuple[str, ...]:
        """Return the fields that it writes; all others are left alone."""

    @abstractmethod
    def write(self, model: Any, phi: Array) -> None:
        """Write a model in place, phi of shape (k,), nothing where it vanishes."""


class Insertion(ModelChange):
    r"""A change that also needs elements that the model does not have.

    With little of it a simulation would need steps too short to be worth it. What is
    read is then a mixture of what the model reads without the elements and with them,
    as much of it as there is at least,

    .. math::
        x = (1 - w)\, x_{without} + w\, x_{with},

    right to first order, and with a slope where it vanishes.
    """

    @abstractmethod
    def share(self, phi: Array) -> float:
        """Return w of the elements in what is read, within [0, 1], phi of (k,)."""

    @abstractmethod
    def edit(self, spec: Any) -> None:
        """Add the elements to a spec."""

    @abstractmethod
    def settle(self, model: Any, data: Any, phi: Array) -> None:
        """Move what was inserted to where it rests under the load at the start.

        Args:
            model: Model that was written into.
            data: Data at the start, its forces computed.
            phi: Parameters of the effect, shape (k,).
        """


class StateChange(ModelChange):
    """A change that follows the state of joints: added to theirs before every step.

    MuJoCo's own solver then does what a force cannot, such as hold a joint still by dry
    friction that depends on where it is. Rows with such a change are stepped together,
    as those with a :class:`Force`.
    """

    @abstractmethod
    def joints(self) -> tuple[str, ...]:
        """Return the hinges and slides whose entries of its one field it changes."""

    @abstractmethod
    def values(self, q: Array, v: Array, load: Array, phi: Array) -> Array:
        """Return the values added for each joint, shape (n, joints).

        Args:
            q: Positions of the joints, shape (n, joints).
            v: Velocities of the joints.
            load: Forces of the actuators on them in the step before.
            phi: Parameters of the effect, shape (n, k).
        """

    @override
    def write(self, model: Any, phi: Array) -> None:
        """Write nothing before the state is known."""
