"""Signals of goals for a robot's drives, and how large its limits permit them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

BAND = 0.1, 10.0  # Hz
#: Of the signals in which all joints do the same, Hz.
BANDS = (
    *((0.1, 1.0), (0.1, 2.0), (0.1, 5.0), (0.3, 1.0), (1.0, 2.0), (1.0, 3.0)),
    *((1.0, 5.0), (2.0, 3.0), (2.0, 5.0), (3.0, 4.0), (3.0, 7.0), (4.0, 5.0), BAND),
)
ENTRIES = "kind", "share", "center", "low", "high"
#: Of the reach: goals of a soft drive may lie beyond what its joint comes to.
SHARE = 0.08, 4.0
FACTORS = tuple(0.88**k for k in range(40))


@dataclass(frozen=True)
class Played:
    """Goals of all joints, as a generator of signals.

    An action has, for each joint, a kind (below .5 a chirp, else a multisine of four),
    the share of the reach that it takes, where its center lies in what is left, and two
    numbers that a chirp takes for the logarithms of its frequencies, a multisine for
    the band of its own. Behind them stands which gains the drives have.

    Attributes:
        drives: Names of the actuators.
        center: Of each joint's range of goals, rad.
        reach: Half of it.
    """

    drives: tuple[str, ...]
    center: tuple[float, ...]
    reach: tuple[float, ...]

    @property
    def names(self) -> list[str]:
        """Names of the entries."""
        return [f"{drive} {what}" for drive in self.drives for what in ENTRIES]

    def __call__(self, action: Tensor, input_times: Tensor) -> dict[str, Tensor]:
        """Return the goals, {drive: (n, m)}."""
        t = input_times - input_times[0]
        found = {}
        parts = zip(
            self.drives,
            action.split(len(ENTRIES), 1),
            self.center,
            self.reach,
            strict=True,
        )
        for j, (drive, entries, center, reach) in enumerate(parts):
            kind, share, place, low, high = (e[:, None] for e in entries.unbind(1))
            f0, f1 = (_hertz(e) for e in (low, high))
            sweep = torch.sin(2 * math.pi * (f0 * t + (f1 - f0) * t**2 / (2 * t[-1])))
            tones = [
                torch.sin(
                    2 * math.pi * _hertz(low + (high - low) * k / 3) * t
                    + 1.7 * j
                    + k**2
                )
                for k in range(4)
            ]
            signal = torch.where(kind < 0.5, sweep, torch.stack(tones).sum(0) / 2.5)
            away = (1 - share).clamp(min=0.0) * place * reach
            # The first second leads from rest to the signal.
            found[drive] = center + t.clamp(max=1.0) * (away + share * reach * signal)
        return found


def _hertz(share: Tensor) -> Tensor:
    return BAND[0] * (BAND[1] / BAND[0]) ** share


def plain(num_joints: int, models: tuple[float, ...] = (0.0, 1.0)) -> Tensor:
    """Return chirps and multisines of all joints in one band, (n, action_dim)."""
    found = []
    for kind, band, model in product((0.0, 1.0), BANDS, models):
        ends = [math.log(f / BAND[0]) / math.log(BAND[1] / BAND[0]) for f in band]
        found.append([kind, SHARE[1], 0.0, *ends] * num_joints + [model])
    return torch.tensor(found)


def scaled(action: Tensor, k: Tensor) -> Tensor:
    """Return signals (n, action_dim) with the shares times the k-th of ``FACTORS``."""
    tried = action.clone()
    tried[:, 1 :: len(ENTRIES)] *= torch.tensor(FACTORS)[k][:, None]
    return tried


def largest(action: Tensor, permitted: Callable[[Tensor], Tensor]) -> Tensor:
    """Return signals as large as the limits permit, without those that never are.

    The largest of ``FACTORS`` of all shares is sought by halving, as if whatever is
    smaller than a permitted signal were permitted too; what is returned has been tried.

    Args:
        action: Signals, shape (n, action_dim).
        permitted: Returns whether each signal is, shape (n,).

    Returns:
        Shape (m, action_dim), m <= n.
    """
    num = len(FACTORS)
    first = torch.zeros(len(action), dtype=torch.long)
    last = torch.full_like(first, num)  # not permitted, or not known to be
    while bool((first < last).any()):
        middle = (first + last) // 2
        is_permitted = permitted(scaled(action, middle.clamp(max=num - 1)))
        is_open = first < last
        last = torch.where(is_open & is_permitted, middle, last)
        first = torch.where(is_open & ~is_permitted, middle + 1, first)
    return scaled(action, last.clamp(max=num - 1))[last < num]
