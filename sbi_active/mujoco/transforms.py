"""The action of a ``SignalTransform`` of ``mujoco.sysid`` on predicted signals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from typing import Any

import numpy as np

from sbi_active.arrays import Array


@dataclass(frozen=True)
class Signal:
    """A measured signal, its kind by name, and its columns."""

    name: str
    kind: str
    width: int


@dataclass(frozen=True)
class SignalReadout:
    """The action of a transform on predicted signals, by channel.

    Attributes:
        stamp: Time by which a reading is stamped late, (c,), s.
        delays: Place in (theta, fixed values) of a channel's delay.
        changes: Channel, operation of NumPy, and place of what it takes, in order.
        fixed: Values of frozen parameters.
        window: Lowest and highest delay.
    """

    stamp: Array
    delays: dict[int, int] = field(default_factory=dict)
    changes: Sequence[tuple[int, np.ufunc, int]] = field(default_factory=list)
    fixed: Array = field(default_factory=lambda: np.zeros(0))
    window: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of(
        cls, transform: Any, params: Any, names: Sequence[str], stamp: Array
    ) -> SignalReadout:
        """Return the readout of a ``SignalTransform``, or of none.

        What is done to the measured signals is undone in the predicted ones; what is
        done to both changes no comparison.

        Args:
            transform: The transform, or None.
            params: A ``ParameterDict``.
            names: Name of each channel's signal.
            stamp: Time by which a reading is stamped late, (c,), s.
        """
        if transform is None:
            return cls(stamp)
        places, fixed = _places(params)
        delays = {
            c: places[parameter]
            for pattern, parameter, _ in transform._delays
            for c, name in enumerate(names)
            if fnmatch(name, pattern)
        }
        steps = (
            (transform._gains, "predicted", np.multiply),
            (transform._biases, "predicted", np.add),
            (transform._biases, "measured", np.subtract),
            (transform._gains, "measured", np.divide),
        )
        changes = [
            (c, change, places[parameter])
            for every, side, change in steps
            for pattern, parameter, target in every
            for c, name in enumerate(names)
            if target == side and fnmatch(name, pattern)
        ]
        return cls(stamp, delays, changes, fixed, transform._compute_delay_bounds())

    def late(self, theta: Array) -> Array:
        """Return by how much each channel reads what was there before, (n, c), s."""
        late = np.repeat(self.stamp[None], len(theta), 0)
        for channel, place in self.delays.items():
            late[:, channel] += self._values(theta)[:, place]
        return late

    def read(self, x: Array, theta: Array) -> Array:
        """Return signals as they would have been measured, (n, k, c)."""
        x = x.copy()
        for channel, change, place in self.changes:
            change(
                x[..., channel], self._values(theta)[:, [place]], out=x[..., channel]
            )
        return x

    def _values(self, theta: Array) -> Array:
        return np.concatenate([theta, np.repeat(self.fixed[None], len(theta), 0)], 1)


def _places(params: Any) -> tuple[dict[str, int], Array]:
    """Return the first place of each parameter in theta, frozen ones behind it."""
    places: dict[str, int] = {}
    free, fixed = 0, np.zeros(0)
    for name, parameter in params.items():
        if parameter.frozen:
            places[name] = params.size + len(fixed)
            fixed = np.append(fixed, parameter.as_vector())
        else:
            places[name] = free
            free += parameter.size
    return places, fixed
