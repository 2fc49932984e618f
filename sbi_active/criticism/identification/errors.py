r"""Errors of trajectories whose size, duration and shape are unknown, by channel.

.. math::
    C = \sigma^2 \bigl(w I + (1 - w) K_\tau\bigr), \qquad
    K(d) = e^{-d / \tau} \ \text{or}\
    \bigl(1 + \tfrac{\sqrt3 d}{\tau}\bigr) e^{-\sqrt3 d / \tau}

in each trial, or white noise. Both kernels are those of a Markov process, so that a
Kalman filter whitens n numbers in O(n), at any times; logs of robots are long. What
:mod:`..misfit.processes` does by eigenvectors for the rivals of a verdict is done here
for one model, and the size is a parameter of each channel.

References:
    Hartikainen & Särkkä, IEEE MLSP 2010, for Matérn kernels as state-space models.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.data.measurements import Measurements

Array = NDArray[Any]

#: Shares of the variance that are white, of errors of unknown size.
SHARES = (1e-4, 1e-3, 0.01, 0.03, 0.1, 0.3, 0.6, 0.9)
#: Smallest share of a declared white error: below it sums of squares lose their digits.
LEAST = 1e-12
#: Time scales from this number of samples to this share of a trial, and their number.
SAMPLES, TRIAL, NUM_TIMES = 0.7, 0.8, 9
#: Numbers that are whitened before they are summed up.
NUMBERS = 2_000_000
#: Prior probability that errors are white.
WHITE = 0.5


@dataclass(frozen=True)
class Hypotheses:
    """Errors of one channel, given their size, h of them, white noise first.

    Attributes:
        share: Of the variance that is white, w, shape (h,).
        time: Its scale, shape (h,); inf for white noise.
        smooth: Whether the kernel is the Matérn one, bool, shape (h,).
        log_prior: Shape (h,).
    """

    share: Array
    time: Array
    smooth: NDArray[np.bool_]
    log_prior: Array

    @classmethod
    def of(cls, measurements: Measurements, declared: float = 1.0) -> Hypotheses:
        """Return those that some measurements can tell.

        Args:
            measurements: Which say what time scales can be told.
            declared: Share of the variance of residuals that a declared white error
                has at least in all channels; shares go on by tens to a tenth of it.
        """
        m = measurements
        tens = np.log10(SHARES[0] / max(declared / 10, LEAST))
        below = SHARES[0] * 10.0 ** -np.arange(max(np.ceil(tens), 0), 0, -1)
        starts = np.flatnonzero(~np.isfinite(m.gap))
        ends = np.append(starts[1:], len(m))
        spans = m.time[ends - 1] - m.time[starts]
        span = max(float(np.median(spans)), 2 * m.step)
        low = SAMPLES * m.step
        times = np.geomspace(low, max(TRIAL * span, 2 * low), NUM_TIMES)
        parts = np.meshgrid([*below, *SHARES], times, [False, True], indexing="ij")
        share, time, smooth = (part.ravel() for part in parts)
        num = len(share)
        return cls(
            np.append(1.0, share),
            np.append(np.inf, time),
            np.append(False, smooth),
            np.log(np.append(WHITE, np.full(num, (1 - WHITE) / num))),
        )

    def __len__(self) -> int:
        return len(self.share)

    def only(self, place: int) -> Hypotheses:
        """Return a single one."""
        one = slice(place, place + 1)
        parts = (self.share, self.time, self.smooth, self.log_prior)
        return Hypotheses(*(part[one] for part in parts))

    def transition(self, gap: float) -> Array:
        """Return how the state moves on over a gap, shape (h, 2, 2); the first is x."""
        move = np.zeros((len(self), 2, 2))
        a = gap / self.time
        move[:, 0, 0] = np.exp(-a)
        b = np.sqrt(3) * a[self.smooth]
        decay = np.exp(-b)
        # In units in which both states have a variance of one.
        move[self.smooth] = np.moveaxis(
            np.array([[decay * (1 + b), decay * b], [-decay * b, decay * (1 - b)]]),
            -1,
            0,
        )
        return move


@dataclass(frozen=True)
class Grams:
    """What whitened rows of one channel come to, hypothesis by hypothesis.

    Attributes:
        gram: Of rows (1 + d), by fold, shape (h, f, 1 + d, 1 + d).
        log_det: Of the covariance at size one, by fold, shape (h, f).
        count: Numbers, by fold, shape (f,).
    """

    gram: Array
    log_det: Array
    count: Array

    @property
    def total(self) -> tuple[Array, Array, int]:
        """Over all folds: shapes (h, 1 + d, 1 + d), (h,), and the number."""
        return self.gram.sum(1), self.log_det.sum(1), int(self.count.sum())


def grams(
    rows: Array,
    measurements: Measurements,
    hypotheses: Hypotheses,
    fold: NDArray[np.int64],
) -> list[Grams]:
    """Return Gram matrices of whitened rows, one a channel.

    Args:
        rows: Residual and its derivatives, shape (N, 1 + d).
        measurements: In the order trial, channel, time.
        hypotheses: Of the errors.
        fold: Part of each number, shape (N,); it starts a new series, as a trial does.
    """
    m, k = measurements, rows.shape[1]
    num, folds = int(m.channel.max()) + 1, int(fold.max()) + 1
    starts = ~np.isfinite(m.gap)
    starts[1:] |= fold[1:] != fold[:-1]
    first = np.flatnonzero(starts)
    series = np.split(np.arange(len(m)), first[1:])
    alike: dict[bytes, list[NDArray[np.intp]]] = {}
    for at in series:
        gaps = np.round(np.diff(m.time[at]) / m.step, 6)
        alike.setdefault(gaps.tobytes(), []).append(at)
    found = np.zeros((num, len(hypotheses), folds, k, k))
    logs = np.zeros((num, len(hypotheses), folds))
    for group in alike.values():
        places = np.stack(group)  # (b, n)
        where = [(m.channel[at[0]], slice(None), fold[at[0]]) for at in places]
        time, filters = m.time[places[0]], Filter(hypotheses)
        size = max(NUMBERS // (len(hypotheses) * len(places) * k), 1)
        for first in range(0, len(time), size):
            some = slice(first, first + size)
            white = filters(rows[places[:, some]], time[some])
            for b, own in enumerate(white):
                found[where[b]] += np.swapaxes(own, 1, 2) @ own
        for own in where:
            logs[own] += filters.log_det
    count = np.zeros((num, folds))
    np.add.at(count, (m.channel, fold), 1)
    return [Grams(found[c], logs[c], count[c]) for c in range(num)]


class Filter:
    """Kalman filters of series with the same times, one a hypothesis of size one.

    Attributes:
        log_det: Of the covariance of what was filtered so far, shape (h,).
    """

    def __init__(self, hypotheses: Hypotheses) -> None:
        self.hypotheses = hypotheses
        self.log_det = np.zeros(len(hypotheses))
        self._steady = (1 - hypotheses.share)[:, None, None] * np.eye(2)
        self._cov = self._steady.copy()
        self._state: Array | None = None
        self._last = 0.0
        self._known: dict[float, Array] = {}

    def __call__(self, series: Array, time: Array) -> Array:
        """Return the innovations of the series that follow, whitened.

        Args:
            series: Shape (b, n, k).
            time: Shape (n,).

        Returns:
            Shape (b, h, n, k).
        """
        b, n, k = series.shape
        h, share = len(self.hypotheses), self.hypotheses.share
        flat = np.swapaxes(series, 0, 1).reshape(n, b * k)
        found = np.empty((n, h, b * k))
        cov, state = self._cov, self._state
        for i in range(n):
            if state is None:
                state = np.zeros((h, 2, b * k))
            else:
                move = self._move(float(time[i]) - self._last)
                state = move @ state
                cov = move @ (cov - self._steady) @ np.swapaxes(move, 1, 2)
                cov += self._steady
            self._last = float(time[i])
            variance = cov[:, 0, 0] + share
            innovation = flat[i] - state[:, 0]
            found[i] = innovation / np.sqrt(variance)[:, None]
            self.log_det += np.log(variance)
            gain = cov[:, :, 0] / variance[:, None]
            state = state + gain[:, :, None] * innovation[:, None]
            cov = cov - gain[:, :, None] * cov[:, None, 0]
        self._cov, self._state = cov, state
        return np.moveaxis(found.reshape(n, h, b, k), 2, 0).swapaxes(1, 2)

    def _move(self, gap: float) -> Array:
        key = round(gap, 12)
        if key not in self._known:
            self._known[key] = self.hypotheses.transition(gap)
        return self._known[key]


def whitened(
    rows: Array, measurements: Measurements, hypotheses: Hypotheses, chosen: Array
) -> Array:
    """Return rows (N, k) in the metric of one hypothesis a channel, shape (c,)."""
    m, found = measurements, np.empty_like(rows)
    first = np.flatnonzero(~np.isfinite(m.gap))
    for at in np.split(np.arange(len(m)), first[1:]):
        one = Filter(hypotheses.only(int(chosen[m.channel[at[0]]])))
        found[at] = one(rows[at][None], m.time[at])[0, 0]
    return found
