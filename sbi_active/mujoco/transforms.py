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


@dataclass
class SignalReadout:
    """The action of a transform on predicted signals, by channel.

    Attributes:
        names: Names of the channels' signals.
        stamp: Time by which a reading is stamped late, (c,), s.
        delays: Place in (theta, fixed values) of each channel's delay, -1 for none.
        scales: Pairs of a place and whether it divides, a list a channel.
        shifts: Pairs of a place and a sign, those that are divided too, a list each.
        fixed: Values of frozen parameters.
        window: Lowest and highest delay.
        enabled: Signals that are returned; None for all.
    """

    names: list[str]
    stamp: Array
    delays: list[int]
    scales: list[list[tuple[int, bool]]]
    shifts: list[list[tuple[int, bool]]]
    fixed: Array
    window: tuple[float, float]
    enabled: list[str] | None

    @classmethod
    def of(
        cls, transform: Any, params: Any, signals: Sequence[Signal], stamp: Array
    ) -> SignalReadout:
        """Return the readout of a ``SignalTransform``, or of none."""
        names = [s.name for s in signals for _ in range(s.width)]
        width = len(names)
        found = cls(
            names,
            stamp,
            [-1] * width,
            [[] for _ in range(width)],
            [[] for _ in range(width)],
            np.zeros(0),
            (0.0, 0.0),
            None,
        )
        if transform is None:
            return found
        places, found.fixed = _places(params)
        for pattern, parameter, _ in transform._delays:
            for c, name in enumerate(names):
                if fnmatch(name, pattern):
                    found.delays[c] = places[parameter][0]
        for given, into in (
            (transform._gains, found.scales),
            (transform._biases, found.shifts),
        ):
            for pattern, parameter, target in given:
                for c, name in enumerate(names):
                    # What is done to both sides alike changes no comparison.
                    if fnmatch(name, pattern) and target != "both":
                        into[c].append((places[parameter][0], target == "measured"))
        found.window = transform._compute_delay_bounds()
        found.enabled = transform._enabled_sensors
        return found

    def keeps(self, name: str) -> bool:
        """Return whether a channel is returned."""
        return self.enabled is None or name.partition("[")[0] in self.enabled

    def only(self, kept: Sequence[int]) -> SignalReadout:
        """Return the readout of some channels."""
        return SignalReadout(
            [self.names[k] for k in kept],
            self.stamp[list(kept)],
            [self.delays[k] for k in kept],
            [self.scales[k] for k in kept],
            [self.shifts[k] for k in kept],
            self.fixed,
            self.window,
            self.enabled,
        )

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


def _places(params: Any) -> tuple[dict[str, list[int]], Array]:
    """Return places of each parameter's entries in theta, frozen ones behind it."""
    places, free = {}, 0
    fixed: list[float] = []
    for name in params.keys():  # noqa: SIM118
        parameter = params[name]
        if parameter.frozen:
            places[name] = [params.size + len(fixed) + k for k in range(parameter.size)]
            fixed += parameter.as_vector().tolist()
        else:
            places[name] = [free + k for k in range(parameter.size)]
            free += parameter.size
    return places, np.array(fixed)
