"""The action of a ``SignalTransform`` of ``mujoco.sysid`` on predicted signals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
        delays: Place in (theta, fixed values) of each channel's delay, -1 for none.
        scales: Pairs of a place and whether it divides, a list a channel.
        shifts: Pairs of a place and whether it is subtracted, a list a channel.
        fixed: Values of frozen parameters.
        window: Lowest and highest delay.
    """

    stamp: Array
    delays: list[int]
    scales: list[list[tuple[int, bool]]]
    shifts: list[list[tuple[int, bool]]]
    fixed: Array
    window: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of(
        cls, transform: Any, params: Any, names: Sequence[str], stamp: Array
    ) -> SignalReadout:
        """Return the readout of a ``SignalTransform``, or of none.

        Args:
            transform: The transform, or None.
            params: A ``ParameterDict``.
            names: Name of each channel's signal.
            stamp: Time by which a reading is stamped late, (c,), s.
        """
        delays = [-1 for _ in names]
        scales, shifts = ([[] for _ in names] for _ in range(2))
        if transform is None:
            return cls(stamp, delays, scales, shifts, np.zeros(0))
        places, fixed = _places(params)
        for c, name in enumerate(names):
            for pattern, parameter, _ in transform._delays:
                if fnmatch(name, pattern):
                    delays[c] = places[parameter]
            given = (transform._gains, scales[c]), (transform._biases, shifts[c])
            for every, into in given:
                for pattern, parameter, target in every:
                    # What is done to both sides alike changes no comparison.
                    if fnmatch(name, pattern) and target != "both":
                        into.append((places[parameter], target == "measured"))
        window = transform._compute_delay_bounds()
        return cls(stamp, delays, scales, shifts, fixed, window)

    def late(self, theta: Array) -> Array:
        """Return by how much each channel reads what was there before, (n, c), s."""
        values = self._values(theta)
        late = np.repeat(self.stamp[None], len(theta), 0)
        for c, place in enumerate(self.delays):
            if place >= 0:
                late[:, c] += values[:, place]
        return late

    def read(self, x: Array, theta: Array) -> Array:
        """Return signals as they would have been measured, (n, k, c)."""
        values = self._values(theta)
        x = x.copy()
        for c in range(x.shape[2]):
            for place, is_measured in self.scales[c]:
                if not is_measured:
                    x[..., c] *= values[:, [place]]
            for place, is_measured in self.shifts[c]:
                x[..., c] += (-1 if is_measured else 1) * values[:, [place]]
            for place, is_measured in self.scales[c]:
                if is_measured:
                    x[..., c] /= values[:, [place]]
        return x

    def _values(self, theta: Array) -> Array:
        return np.concatenate([theta, np.repeat(self.fixed[None], len(theta), 0)], 1)


def _places(params: Any) -> tuple[dict[str, int], Array]:
    """Return the first place of each parameter in theta, frozen ones behind it."""
    places, free = {}, 0
    fixed: list[float] = []
    for name in params.keys():  # noqa: SIM118
        parameter = params[name]
        if parameter.frozen:
            places[name] = params.size + len(fixed)
            fixed += parameter.as_vector().tolist()
        else:
            places[name] = free
            free += parameter.size
    return places, np.array(fixed)
