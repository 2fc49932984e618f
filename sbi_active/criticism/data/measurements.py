"""Measured numbers in one row, with what their errors depend on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as fisher

from sbi_active.arrays import Array
from sbi_active.criticism.data.trials import Trials
from sbi_active.expected import require


@dataclass(frozen=True)
class Measurements:
    """The measured numbers of some trials, in the order trial, channel, time.

    Attributes:
        x: Measured numbers, shape (N,).
        position: Position of each number in the flattened x of shape (t, *x_shape),
            shape (N,).
        trial: Row of its trial, shape (N,).
        channel: Channel of each number, shape (N,).
        time: Sample time of each number; its place along x's first axis where no times
            are given, shape (N,).
        has_time: Whether x has a time axis.
        valid: Trials with any measurement, shape (t,), bool.
        shape: (t, *x_shape).
    """

    x: Array
    position: NDArray[np.int64]
    trial: NDArray[np.int64]
    channel: NDArray[np.int64]
    time: Array
    has_time: bool
    valid: Array
    shape: tuple[int, ...]

    @classmethod
    def of(
        cls,
        trials: Trials,
        model_times: Array | None = None,
        *,
        is_sequence: bool = False,
    ) -> Measurements:
        """Return the measurements of some trials.

        Args:
            trials: Trials. Their x has a time axis where they, or the model, have
                sample times.
            model_times: The simulator's sample times.
            is_sequence: The first axis of x is a time axis whose samples are counted.
        """
        x = trials.x.double().numpy()
        num, length = x.shape[:2]
        stamps = model_times
        if trials.sample_times is not None:
            stamps = trials.sample_times.double().numpy()
        has_time = is_sequence or stamps is not None
        if stamps is None:
            stamps = np.arange(length, dtype=float)
        each = stamps.shape[-1]
        expected = f"x of {each} samples a trial, as the simulator has times"
        advice = "measure at these, or give the trials sample_times (columns time)"
        require(each == length, expected, f"shape {x.shape[1:]}", advice)
        # (trial, channel, time), where x without a time axis has one "time" a channel.
        channels = x.reshape(num, length, -1).transpose(0, 2, 1)
        stamps = np.broadcast_to(stamps, (num, length))
        keep = np.isfinite(channels) & np.isfinite(stamps)[:, None]
        trial, channel, place = np.nonzero(keep)
        size = x.size // num
        position = trial * size + place * channels.shape[1] + channel
        time = stamps[trial, place]
        if not has_time:
            time, channel = 0 * time, position % size
        valid = np.asarray(np.isfinite(x.reshape(num, -1)).any(1))
        numbers = channels[keep], position, trial, channel, time
        return cls(*numbers, has_time, valid, x.shape)

    @cached_property
    def gap(self) -> Array:
        """Time since the number before in its trial and channel; inf for the first."""
        gap = np.full(len(self), np.inf)
        if self.has_time:
            a, b = self.trial, self.channel
            follows = (a[1:] == a[:-1]) & (b[1:] == b[:-1])
            gap[1:] = np.where(follows, np.diff(self.time), np.inf)
        return gap

    def bounded(self, center: Array, reach: Array) -> Measurements:
        """Return the measurements with implausible numbers moved within a reach.

        Such a number is wrong whatever its digits are, and in double precision its
        residual would no longer depend on the simulator. If most trials are so far off,
        the model is wrong instead, and nothing is changed.

        Args:
            center: Center of what can be expected, shape (N,).
            reach: Distance from it that numbers may have, shape (N,).
        """
        x = np.clip(self.x, center - reach, center + reach)
        beyond = np.unique(self.trial[x != self.x])
        few = 0 < len(beyond) <= self.valid.sum() / 2
        return replace(self, x=x) if few else self

    def by_channel(self, values: Array) -> Array:
        """Return the mean of values (N,) in each channel, shape (c,)."""
        count = np.bincount(self.channel)
        return np.bincount(self.channel, values) / np.maximum(count, 1)

    def part(self, at: NDArray[np.bool_]) -> Measurements:
        """Return some of the numbers, shape (N,), with all of their trials."""
        names = ("x", "position", "trial", "channel", "time")
        return replace(self, **{name: getattr(self, name)[at] for name in names})

    def __len__(self) -> int:
        return len(self.x)

    @property
    def is_sequence(self) -> bool:
        """Whether any number follows another in time."""
        return self.has_time and bool(np.isfinite(self.gap).any())

    @property
    def step(self) -> float:
        """Median time between neighboring numbers; 1 without a time axis."""
        gaps = self.gap[np.isfinite(self.gap)]
        return float(np.median(gaps)) if len(gaps) else 1.0

    @property
    def span(self) -> float:
        """Time from the first to the last number."""
        return max(float(np.ptp(self.time)), self.step) if len(self) else 1.0


def shared_errors(white: Array, place: Array) -> tuple[float, float]:
    """Return the variance of errors summed over trials, and its tail probability.

    What a model lacks may come again at the same times of each trial, and copies of a
    trial have all of its errors. The test is that of an analysis of variance.

    Args:
        white: Independent errors of equal variance if nothing is shared, shape (N,).
        place: Channel and time of each, shape (2, N).

    Returns:
        The variance in units of what independent errors have: one, to the number of
        trials where all are the same.
    """
    _, group, count = np.unique(place, axis=1, return_inverse=True, return_counts=True)
    several, group = count > 1, group.reshape(-1)
    own, between, within = several[group], several.sum(), (count[several] - 1).sum()
    total, sums = (white[own] ** 2).sum(), np.bincount(group, white)[several]
    if not total:
        return 1.0, 1.0
    square = (sums**2 / count[several]).sum()
    ratio, rest = square / between, max(total - square, 1e-12 * total) / within
    larger = float(max(ratio * own.sum() / total, 1.0))
    return larger, float(fisher.sf(ratio / rest, between, within))
