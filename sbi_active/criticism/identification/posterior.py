r"""Draws of parameters of a linear model with unknown errors and doubtful effects.

.. math::
    r(u) = r_0 + J u, \qquad r_c \sim \mathcal N(0, \sigma_c^2 C_{h_c})

in every channel c, with u = (theta, phi) between bounds. An effect is absent, its part
of u zero, unless it is there: what may be missing widens the intervals by as much as
the logs leave it open, and hardly where they exclude it. Blocks of the Gibbs sampler
are the errors' shape and size by channel, each effect's presence with all of u summed
out, and u: as it is without bounds where that is within them, else along the
eigenvectors of its precision.

References:
    George & McCulloch, Statistica Sinica 7 (1997), for the presence of variables.
    Goodnight, The American Statistician 33 (1979), for the sweep operator.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.criticism.identification.settings import SamplerSettings
from sbi_active.criticism.linear.processes import Grams, Processes
from sbi_active.criticism.rivals.error_models import drawn
from sbi_active.inference.sampling.eigen import eigh
from sbi_active.inference.sampling.truncated import log_inside, truncated_normal

Flags = NDArray[np.bool_]

TINY = 1e-300  # keeps logarithms finite


@dataclass(frozen=True)
class Unknowns:
    """Prior knowledge of u, d coordinates from where effects vanish.

    Attributes:
        low: Lower bounds, shape (d,).
        high: Upper bounds, shape (d,).
        center: Center of a Gaussian prior, shape (d,).
        precision: Precision of that prior, 0 for uniform ones, shape (d,).
        effect: Number of the effect that a coordinate belongs to, -1 for theta, (d,).
    """

    low: Array
    high: Array
    center: Array
    precision: Array
    effect: NDArray[np.int64]

    @property
    def num_effects(self) -> int:
        """Number of doubtful effects."""
        return int(self.effect.max(initial=-1)) + 1

    @property
    def log_density(self) -> Array:
        """Log constant of the prior for each effect that is there, shape (e,)."""
        own = np.flatnonzero(self.effect >= 0)
        center, precision = self.center[own], self.precision[own]
        log_p = 0.5 * (np.log(np.maximum(precision, TINY)) - precision * center**2)
        sd = 1 / np.sqrt(np.maximum(precision, TINY))
        log_p = log_p - log_inside(center, sd, self.low[own], self.high[own])
        return np.bincount(self.effect[own], log_p, self.num_effects)


@dataclass(frozen=True)
class Draws:
    """Draws of the posterior.

    Attributes:
        u: Coordinates, shape (n, d).
        present: Whether each effect is there, bool, shape (n, e).
        errors: Hypothesis of each channel, shape (n, c).
        size: Deviation of each channel's errors, shape (n, c).
    """

    u: Array
    present: Flags
    errors: NDArray[np.int64]
    size: Array


@dataclass(frozen=True)
class Sampler:
    """Gibbs sampler of a linear model.

    Attributes:
        grams: Gram matrices of (r_0, J), by channel.
        processes: Hypotheses of the errors, white noise first, of size one.
        unknowns: Priors of the unknowns.
        known_size: Deviation of the white part by channel; None if it is unknown.
        rng: Source of the draws.
        settings: Numbers of draws, and priors.
    """

    grams: Grams
    processes: Processes
    unknowns: Unknowns
    known_size: Sequence[float | None]
    rng: np.random.Generator
    settings: SamplerSettings = SamplerSettings()

    def draws(self, sweeps: int) -> Draws:
        """Return posterior draws of all chains.

        Args:
            sweeps: Sweeps of each chain, after those that are left out.
        """
        p, own, d = self.unknowns, self.settings, len(self.unknowns.low)
        ridge = p.precision + own.flat / (p.high - p.low) ** 2
        u = np.clip(np.zeros((own.chains, d)), p.low, p.high)
        present = np.ones((own.chains, p.num_effects), dtype=bool)
        kept: list[tuple[Array, ...]] = []
        for sweep in range(own.burnt + sweeps):
            shape = own.chains, d, d
            precision = np.broadcast_to(np.diag(ridge), shape).copy()
            linear = np.broadcast_to(p.precision * p.center, u.shape).copy()
            errors = [self._errors(c, u) for c in range(len(self.known_size))]
            for c, (h, variance) in enumerate(errors):
                gram = self.grams.gram[h, c] / variance[:, None, None]
                precision += gram[:, 1:, 1:]
                linear -= gram[:, 1:, 0]
            swept = _Swept(precision, linear).turned(np.flatnonzero(p.effect < 0))
            for e, there in enumerate(present.T):
                swept[there] = swept[there].turned(np.flatnonzero(p.effect == e))
            present = self._present(swept, present)
            u = self._moved(u, precision, swept)
            if sweep >= own.burnt:
                chosen, variances = zip(*errors, strict=True)
                sizes = np.sqrt(np.stack(variances, 1))
                kept.append((u.copy(), present.copy(), np.stack(chosen, 1), sizes))
        return Draws(*(np.concatenate(part) for part in zip(*kept, strict=True)))

    @cached_property
    def _log_prior(self) -> Array:
        """Log prior probability of each hypothesis of the errors, shape (h,)."""
        num, absent = len(self.processes), self.settings.absent
        log_prior = np.full(num, np.log((1 - absent) / max(num - 1, 1)))
        log_prior[0] = np.log(absent)
        return log_prior

    def _errors(self, channel: int, u: Array) -> tuple[NDArray[np.intp], Array]:
        """Return the shape and the variance of one channel's errors, given u."""
        gram, size = self.grams.gram[:, channel], self.known_size[channel]
        count, rng = int(self.grams.count[channel]), self.rng
        one = np.concatenate([np.ones((len(u), 1)), u], 1)
        square = (one[:, :, None] * one[:, None]).reshape(len(u), -1)
        square = np.maximum(square @ gram.reshape(len(gram), -1).T, TINY)
        log_p = self._log_prior - 0.5 * self.grams.log_det[:, channel]
        if size is None:  # with the variance summed out, p(v) = 1 / v
            (h,) = drawn(log_p - 0.5 * count * np.log(square), rng)
            half = square[np.arange(len(u)), h] / 2
            return h, half / rng.gamma(0.5 * count, size=len(u))
        every = size**2 / self.processes.white
        (h,) = drawn(log_p - 0.5 * (square / every + count * np.log(every)), rng)
        return h, every[h]

    def _present(self, swept: _Swept, present: Flags) -> Flags:
        """Return the effects that are there, one after the other given all others.

        Args:
            swept: Gaussians given the effects that are there; changed in place.
            present: Mask of the effects that are there so far, shape (n, e).
        """
        p, present, absent = self.unknowns, present.copy(), self.settings.absent
        log_odds = np.log(absent ** (-1 / max(p.num_effects, 1)) - 1) + p.log_density
        log_z = swept.log_evidence(p)
        for e in self.rng.permutation(p.num_effects):
            other = swept.turned(np.flatnonzero(p.effect == e))
            log_other = other.log_evidence(p)
            gain = log_other - log_z + np.where(present[:, e], -1, 1) * log_odds[e]
            flip = self.rng.logistic(size=len(gain)) < gain
            present[:, e] ^= flip
            log_z = np.where(flip, log_other, log_z)
            swept[flip] = other[flip]
        return present

    def _moved(self, u: Array, precision: Array, swept: _Swept) -> Array:
        """Return u drawn within its bounds.

        As if there were none, where that is within them; else along the eigenvectors of
        its precision. The first is exact, and whether it is chosen depends on no
        earlier u.
        """
        p, rng, free = self.unknowns, self.rng, swept.free
        mean = np.where(free, swept.table[:, :-1, -1], 0.0)
        full = np.where(free[:, :, None] & free[:, None], precision, np.eye(len(p.low)))
        upper = np.swapaxes(np.linalg.cholesky(full), 1, 2)
        new = np.linalg.solve(upper, rng.standard_normal((*u.shape, 1)))[..., 0]
        new = np.where(free, mean + new, 0.0)
        out = np.flatnonzero(((new < p.low) | (new > p.high)).any(1))
        if not len(out):
            return new
        u, mean, free = np.where(free, u, 0.0)[out], mean[out], free[out]
        values, vectors = eigh(full[out])
        sd = 1 / np.sqrt(values)
        for j in range(u.shape[1]):
            is_along = free & (np.abs(vectors[:, :, j]) > 1e-12)
            e = np.where(is_along, vectors[:, :, j], 0.0)
            with np.errstate(divide="ignore", invalid="ignore"):
                ends = np.stack([(p.low - u) / e, (p.high - u) / e])
            ends = np.where(e == 0, np.array([-np.inf, np.inf])[:, None, None], ends)
            low = np.minimum(ends.min(0).max(1), 0.0)
            high = np.maximum(ends.max(0).min(1), 0.0)
            off = (e * (mean - u)).sum(1)  # along it u is independent of all others
            step = truncated_normal(off, sd[:, j], low, high, rng)
            moved = u + np.where(e.any(1), step, 0.0)[:, None] * e
            u = np.clip(moved, p.low, p.high)
        new[out] = np.where(free, u, 0.0)
        return new


class _Swept:
    r"""Gaussians of u without bounds, given what is free of it, by the sweep operator.

    Attributes:
        table: Minus the covariance of what is free, its mean in the last column, and
            in the corner :math:`-b^T P^{-1} b`; shape (n, d + 1, d + 1).
        log_det: Log determinant of the precision of what is free, shape (n,).
        free: Shape (n, d).
    """

    def __init__(self, precision: Array, linear: Array) -> None:
        table = np.concatenate([precision, linear[:, None]], 1)
        right = np.concatenate([linear, np.zeros((len(linear), 1))], 1)
        self.table = np.concatenate([table, right[:, :, None]], 2)
        self.log_det = np.zeros(len(linear))
        self.free = np.zeros(linear.shape, dtype=bool)

    def __getitem__(self, rows: Any) -> _Swept:
        new = copy(self)
        new.table, new.free = self.table[rows].copy(), self.free[rows].copy()
        new.log_det = self.log_det[rows].copy()
        return new

    def __setitem__(self, rows: Any, other: _Swept) -> None:
        self.table[rows], self.free[rows] = other.table, other.free
        self.log_det[rows] = other.log_det

    def turned(self, places: NDArray[np.intp]) -> _Swept:
        """Return those where some coordinates are free that were not, or vice versa."""
        new = self[:]
        for k in places:
            row = new.table[:, k].copy()
            pivot = row[:, [k]]
            over = row / pivot
            new.table -= over[:, :, None] * row[:, None]
            over = np.where(new.free[:, [k]], -over, over)
            new.table[:, k], new.table[:, :, k] = over, over
            new.table[:, k, k] = -1 / pivot[:, 0]
            new.log_det += np.log(np.abs(pivot[:, 0]))
            new.free[:, k] = ~new.free[:, k]
        return new

    def log_evidence(self, p: Unknowns) -> Array:
        """Return the log evidence of what is free, up to what all share, (n,)."""
        some = np.isfinite(p.low) | np.isfinite(p.high)
        free = self.free[:, some]
        variance = -np.einsum("nii->ni", self.table)[:, :-1][:, some]
        sd = np.sqrt(np.where(free, variance, 1.0))
        mean = np.where(free, self.table[:, :-1, -1][:, some], 0.0)
        inside = log_inside(mean, sd, p.low[some], p.high[some])
        log_z = np.where(free, inside, 0.0).sum(1)
        return log_z - 0.5 * (self.table[:, -1, -1] + self.log_det)
