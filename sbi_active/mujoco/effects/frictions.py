"""Dry friction that follows the state of its joint: where it is, its load, its speed.

MuJoCo's own constraint holds the joint still below the friction of the moment, which no
generalized force can do.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from sbi_active.criticism.effects.effect import Effect
from sbi_active.mujoco.effects.acting import half_normal, model_effect
from sbi_active.mujoco.effects.nominal import Nominal
from sbi_active.mujoco.effects.ties import Group
from sbi_active.mujoco.models.changes import StateChange
from sbi_active.mujoco.models.names import element_id

__all__ = ["FrictionChange", "of_friction"]

Array = NDArray[Any]

#: One prior deviation of friction by load, as a share of the load: a gear's
#: inefficiency.
BY_LOAD = 0.2
#: Speed at which static friction has fallen to 1 / e, in root mean squares of it.
TURNING = 0.1


@dataclass(frozen=True)
class FrictionChange(StateChange):
    r"""Adds dry friction to joints.

    Friction by position is larger towards either end of the range in which a joint
    moves,

    .. math::
        F = \phi_1 (1 - w)^2 + \phi_2 w^2, \qquad
        w = \mathrm{clip}\Bigl(\frac{q - q_{low}}{q_{high} - q_{low}}, 0, 1\Bigr),

    of which no part is constant, so that it is told from a plain friction loss; by
    load, of the actuators' force on the joint, :math:`F = \phi |\tau|`; or static
    (Stribeck), :math:`F = \phi e^{-|v| / v_s}`. No phi is negative, so that all of
    them dissipate. Writes ``dof_frictionloss`` before every step.

    Attributes:
        names: Names of the joints.
        what: Quantity that the friction follows.
        low: Lower end of each joint's range, rad or m.
        high: Upper end of each joint's range, rad or m.
        speed: :math:`v_s`, rad/s or m/s.
    """

    names: tuple[str, ...]
    what: Literal["position", "load", "speed"]
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    speed: float = 1.0

    @override
    def fields(self) -> tuple[str, ...]:
        return ("dof_frictionloss",)

    @override
    def joints(self) -> tuple[str, ...]:
        return self.names

    @override
    def values(self, q: Array, v: Array, load: Array, phi: Array) -> Array:
        if self.what == "load":
            return phi * np.abs(load)
        if self.what == "speed":
            return phi * np.exp(-np.abs(v) / self.speed)
        low, high = np.array(self.low), np.array(self.high)
        share = np.clip((q - low) / (high - low), 0.0, 1.0)
        return phi[:, :1] * (1 - share) ** 2 + phi[:, 1:] * share**2


def of_friction(
    group: Group, sizes: Nominal, force: float, unit: str
) -> Iterator[Effect]:
    """Yield dry friction that follows the state of joints that share each phi.

    Args:
        group: Group of joints.
        sizes: Sizes of the model.
        force: Force of one prior deviation.
        unit: Unit of a force.
    """
    model = sizes.model
    dofs = [
        int(model.jnt_dofadr[element_id(model, "joint", name)]) for name in group.names
    ]
    low, high = (tuple(each[dofs].tolist()) for each in (sizes.lowest, sizes.highest))
    speed = TURNING * float(sizes.velocity[dofs].mean())
    if all(a < b for a, b in zip(low, high, strict=True)):
        yield model_effect(
            f"{group.label} friction loss by position",
            FrictionChange(group.names, "position", low, high),
            prior=half_normal(force, 2),
            units=unit,
            family="friction",
            describe=(
                f"dry friction in {group.label} that depends on its position, larger "
                f"by phi_1 at {_listed(low)} and by phi_2 at {_listed(high)}"
            ),
        )
    yield model_effect(
        f"{group.label} friction loss by load",
        FrictionChange(group.names, "load"),
        prior=half_normal(BY_LOAD),
        family="friction",
        describe=(
            f"dry friction in {group.label} that depends on its load, in proportion "
            "to the force of its actuators"
        ),
    )
    yield model_effect(
        f"{group.label} static friction",
        FrictionChange(group.names, "speed", speed=speed),
        prior=half_normal(force),
        units=unit,
        family="friction",
        describe=(
            f"dry friction in {group.label} that depends on its speed, larger at rest "
            f"and gone beyond {speed:.2g}"
        ),
    )


def _listed(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:.3g}" for value in values)
