r"""Errors of trajectories: white noise beside a process that lasts.

.. math::
    C = a I + b K_\tau, \qquad
    K_\tau(d) = e^{-d / \tau} \ \text{or}\
    \bigl(1 + \tfrac{\sqrt3 d}{\tau}\bigr) e^{-\sqrt3 d / \tau}

in each series of numbers that follow each other in time. Both kernels, those of an
Ornstein-Uhlenbeck process and of a Matérn one of smoothness 3/2, belong to a Markov
process, so that a Kalman filter whitens n numbers in O(n), at any times; logs of robots
are long. Its gains depend on no number, and are computed once.

References:
    Hartikainen & Särkkä, IEEE MLSP 2010, for Matérn kernels as state-space models.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.criticism.data.measurements import Measurements


@dataclass(frozen=True)
class Processes:
    """Hypotheses of an error, h of them, those with the smooth kernel last.

    Attributes:
        white: Variance of the white part, a, shape (h,).
        process: Variance of the process, b, shape (h,).
        time: Scale of the process, shape (h,).
        smooth: Whether the kernel is the Matérn one, bool, shape (h,).
    """

    white: Array
    process: Array
    time: Array
    smooth: NDArray[np.bool_]

    @classmethod
    def grid(
        cls, variances: Array, times: Array, kernels: tuple[bool, ...] = (False, True)
    ) -> Processes:
        """Return all combinations: kernel, then time scale, then variances.

        Args:
            variances: Variances of the white part and the process, shape (v, 2).
            times: Times, shape (t,).
            kernels: Whether each kernel is the smooth one, the rough one first.
        """
        shape = len(kernels), len(times), len(variances)
        full = [
            np.broadcast_to(part, shape).ravel()
            for part in (
                variances[:, 0],
                variances[:, 1],
                times[:, None],
                np.array(kernels)[:, None, None],
            )
        ]
        return cls(*full)

    def beside_white(self) -> Processes:
        """Return these and white noise of variance one, which comes first."""
        values = 1.0, 0.0, np.inf, False
        parts = self.white, self.process, self.time, self.smooth
        return Processes(*(np.append(v, p) for v, p in zip(values, parts, strict=True)))

    def __len__(self) -> int:
        return len(self.white)

    def only(self, place: int) -> Processes:
        """Return a single one."""
        one = slice(place, place + 1)
        parts = (self.white, self.process, self.time, self.smooth)
        return Processes(*(part[one] for part in parts))


@dataclass(frozen=True)
class Grams:
    """Gram matrices of whitened rows, hypothesis by hypothesis and group by group.

    Attributes:
        gram: Gram matrices, shape (h, g, k, k).
        log_det: Log determinant of the covariance, shape (h, g).
        count: Numbers of each group, shape (g,).
    """

    gram: Array
    log_det: Array
    count: Array


class Filters:
    """Kalman filters of all series of some measurements.

    Args:
        processes: Hypotheses of the errors.
        measurements: Measurements in the order trial, channel, time.
        fold: Part of each number, shape (N,); it starts a new series, as a trial and a
            channel do.
        group: Group that each number is counted in, the same along a series, shape
            (N,).
    """

    def __init__(
        self,
        processes: Processes,
        measurements: Measurements,
        fold: NDArray[np.int64],
        group: NDArray[np.int64],
    ) -> None:
        self.processes, self.group = processes, group
        self.num_groups = int(group.max()) + 1
        self.places = alike(measurements, fold)
        self._filters = [
            Filter(processes, measurements.time[places[0]]) for places in self.places
        ]

    def grams(self, rows: Array) -> Grams:
        """Return the Gram matrices of rows, shape (N, k)."""
        h, k, num = len(self.processes), rows.shape[1], self.num_groups
        gram, log_det = np.zeros((h, num, k, k)), np.zeros((h, num))
        for places, own in zip(self.places, self._filters, strict=True):
            found = own.grams(rows[places])
            for b, group in enumerate(self.group[places[:, 0]]):
                gram[:, group] += found[:, b]
                log_det[:, group] += own.log_det
        return Grams(gram, log_det, np.bincount(self.group, minlength=num))


def whitened(
    rows: Array,
    processes: Processes,
    m: Measurements,
    chosen: Array,
    fold: NDArray[np.int64],
) -> Array:
    """Return rows (N, k) in the metric of one hypothesis a channel.

    Args:
        rows: Rows, shape (N, k).
        processes: Hypotheses of the errors.
        m: Measurements in the order trial, channel, time.
        chosen: Hypothesis of each channel, shape (c,).
        fold: Part of each number, shape (N,); it starts a new series.
    """
    found = np.empty_like(rows)
    for places in alike(m, fold):
        channel = m.channel[places[:, 0]]
        for c in np.unique(channel):
            at = places[channel == c]
            own = Filter(processes.only(int(chosen[c])), m.time[at[0]])
            found[at] = own.whitened(rows[at])[0]
    return found


def parts_of(m: Measurements, fewest: int, num: int) -> NDArray[np.int64]:
    """Return the part of each number: trials, or parts of them where they are few.

    Args:
        m: The measurements.
        fewest: Trials from which on each is a part.
        num: Parts of fewer ones, at least; each of equally many samples.
    """
    trials, code = np.unique(m.trial, return_inverse=True)
    if len(trials) >= fewest:
        return code.astype(np.int64)
    each = -(-num // len(trials))
    fold = np.empty(len(m), dtype=np.int64)
    for t in range(len(trials)):
        at = code == t
        time = m.time[at]
        edges = np.quantile(time, np.linspace(0, 1, each + 1)[1:-1])
        fold[at] = t * each + np.searchsorted(edges, time, side="left")
    return np.unique(fold, return_inverse=True)[1].astype(np.int64)


def series_of(m: Measurements, fold: NDArray[np.int64]) -> list[NDArray[np.intp]]:
    """Return the numbers of each trial, channel and part, in the order of time."""
    starts = ~np.isfinite(m.gap)
    starts[1:] |= fold[1:] != fold[:-1]
    return np.split(np.arange(len(m)), np.flatnonzero(starts)[1:])


def alike(m: Measurements, fold: NDArray[np.int64]) -> list[NDArray[np.intp]]:
    """Return series that have the same times, of each such group (b, n)."""
    same: dict[bytes, list[NDArray[np.intp]]] = {}
    for at in series_of(m, fold):
        stamps = np.round((m.time[at] - m.time[at[0]]) / m.step, 6)
        same.setdefault(stamps.tobytes(), []).append(at)
    return [np.stack(series) for series in same.values()]


def white_variance(residual: Array, m: Measurements, fold: NDArray[np.int64]) -> float:
    r"""Return the variance of what is white in residuals, by their second differences.

    .. math::
        \frac16 \overline{(r_{i - 1} - 2 r_i + r_{i + 1})^2}

    It does not ask how large the sensor's error was declared. Of what lasts for some
    samples little is in it; zero where no three numbers follow each other.

    Args:
        residual: Residuals, shape (N,).
        m: Measurements in the order trial, channel, time.
        fold: Part of each number, shape (N,); it starts a new series.

    References:
        Gasser, Sroka & Jennen-Steinmetz, Biometrika 73 (1986).
    """
    second = [np.diff(residual[at], 2) for at in series_of(m, fold)]
    every = np.concatenate(second)
    return float(np.mean(every**2) / 6) if len(every) else 0.0


def time_scales(m: Measurements, fold: NDArray[np.int64]) -> Array:
    """Return the time scales that some measurements tell apart, shape (t,).

    They go from .8 steps from sample to sample, of which half is hardly told from white
    noise, to .8 of a series, of which twice is hardly told from a trend, a factor of
    about 2.1 apart.
    """
    spans = [np.ptp(m.time[at]) for at in series_of(m, fold)]
    low = 0.8 * m.step
    high = max(0.8 * max(float(np.median(spans)), m.step), 2 * low)
    return np.geomspace(low, high, 2 + round(np.log(high / low) / np.log(2.1)))


class Filter:
    """Kalman filters of series with the same times, one a hypothesis.

    Args:
        processes: Hypotheses of the errors.
        time: Times, shape (n,).
        most: Whitened numbers in memory at once, 16 MB.

    Attributes:
        log_det: Log determinant of the covariance, shape (h,).
    """

    def __init__(
        self, processes: Processes, time: Array, *, most: int = 2_000_000
    ) -> None:
        p, n = processes, len(time)
        self.most = most
        self.first_smooth = int((~p.smooth).sum())
        process, white, smooth = p.process, p.white, p.smooth
        # In units in which both states have the variance of the process.
        a = np.diff(time)[:, None] / p.time
        b = np.sqrt(3) * a
        decay = np.exp(-np.where(smooth, b, a))
        xx = np.where(smooth, 1 + b, 1.0) * decay
        xv = np.where(smooth, b, 0.0) * decay
        vv = np.where(smooth, 1 - b, 0.0) * decay
        shape = (n, *process.shape)
        deviation, gains = np.empty(shape), np.zeros((2, *shape))
        cxx, cxv, cvv = process, np.zeros_like(process), process
        for i in range(n):
            variance = cxx + white
            deviation[i] = variance
            if i == n - 1:
                break
            x, v = cxx / variance, cxv / variance
            m, k, o = xx[i], xv[i], vv[i]
            gains[:, i] = m * x + k * v, o * v - k * x
            # What is left once the number is known, less what it was before.
            dxx, dxv, dvv = (
                cxx * white / variance,
                cxv * white / variance,
                cvv - cxv * v,
            )
            dxx, dvv = dxx - process, dvv - process
            cxx = process + m * (m * dxx + k * dxv) + k * (m * dxv + k * dvv)
            cxv = m * (o * dxv - k * dxx) + k * (o * dvv - k * dxv)
            cvv = process + k * (k * dxx - o * dxv) + o * (o * dvv - k * dxv)
        self.log_det = np.log(deviation).sum(0)
        self._scale = 1 / np.sqrt(deviation)[..., None, None]
        self._gains = gains[..., None, None]
        some = self.first_smooth
        self._moves = [p[..., None, None] for p in (xx, xv[:, some:], vv[:, some:])]

    def grams(self, series: Array) -> Array:
        """Return the Gram matrices of whitened series, (h, b, k, k), of (b, n, k)."""
        parts = (np.swapaxes(own, -1, -2) @ own for own in self._pieces(series))
        return sum(parts, np.zeros(()))

    def whitened(self, series: Array) -> Array:
        """Return whitened series, shape (h, b, n, k), of series (b, n, k)."""
        return np.concatenate([*self._pieces(series)], 2)

    def _pieces(self, series: Array) -> Iterator[Array]:
        """Yield whitened series, piece by piece in time."""
        b, n, k = series.shape
        h, s = self._scale.shape[1], self.first_smooth
        size = min(max(self.most // (h * b * k), 1), n)
        (gain_x, gain_v), (xx, xv, vv) = self._gains, self._moves
        x, v = np.zeros((h, b, k)), np.zeros((h - s, b, k))
        for first in range(0, n, size):
            last = min(first + size, n)
            found = np.empty((last - first, h, b, k))
            for i in range(first, last):
                off = np.subtract(series[:, i], x, out=found[i - first])
                if i == n - 1:
                    break
                was = x[s:].copy()
                x *= xx[i]
                x += gain_x[i] * off
                if len(v):
                    x[s:] += xv[i] * v
                    v *= vv[i]
                    v -= xv[i] * was
                    v += gain_v[i, s:] * off[s:]
            found *= self._scale[first:last]
            yield np.ascontiguousarray(np.moveaxis(found, 0, 2))
