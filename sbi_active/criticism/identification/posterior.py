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
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

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

    def free(self, present: Flags) -> Flags:
        """Return the coordinates that are not zero, (n, d), by present effects."""
        return np.insert(present, present.shape[1], True, axis=1)[:, self.effect]

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
        p, own = self.unknowns, self.settings
        u = np.clip(np.zeros((own.chains, len(p.low))), p.low, p.high)
        present = np.ones((own.chains, p.num_effects), dtype=bool)
        kept: list[tuple[Array, ...]] = []
        for sweep in range(own.burnt + sweeps):
            each = [self._errors(c, u) for c in range(len(self.known_size))]
            errors, variance = (np.stack(part, 1) for part in zip(*each, strict=True))
            normal = self._normal(errors, variance)
            present = self._present(normal, present)
            u = self._moved(u, normal.given(p.free(present)))
            if sweep >= own.burnt:
                kept.append((u.copy(), present.copy(), errors, np.sqrt(variance)))
        return Draws(*(np.concatenate(part) for part in zip(*kept, strict=True)))

    def _normal(self, errors: NDArray[np.intp], variance: Array) -> _Normal:
        """Return the Gaussians of u without bounds, with all effects there."""
        p, grams = self.unknowns, self.grams.gram
        ridge = np.diag(p.precision + self.settings.flat / (p.high - p.low) ** 2)
        grams = grams[errors, np.arange(errors.shape[1])] / variance[..., None, None]
        total = grams.sum(1)
        linear = p.precision * p.center - total[:, 1:, 0]
        every = np.ones(linear.shape, dtype=bool)
        return _Normal(total[:, 1:, 1:] + ridge, linear, p, every)

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

    def _present(self, normal: _Normal, present: Flags) -> Flags:
        """Return the effects that are there, one after the other given all others.

        Args:
            normal: Gaussians of u.
            present: Mask of the effects that are there so far, shape (n, e).
        """
        p, present, absent = self.unknowns, present.copy(), self.settings.absent
        log_odds = np.log(absent ** (-1 / max(p.num_effects, 1)) - 1) + p.log_density
        log_z = normal.given(p.free(present)).log_evidence
        for e in self.rng.permutation(p.num_effects):
            other = present.copy()
            other[:, e] ^= True
            log_other = normal.given(p.free(other)).log_evidence
            gain = log_other - log_z + np.where(other[:, e], 1, -1) * log_odds[e]
            flip = self.rng.logistic(size=len(gain)) < gain
            present[:, e] ^= flip
            log_z = np.where(flip, log_other, log_z)
        return present

    def _moved(self, u: Array, normal: _Normal) -> Array:
        """Return u drawn within its bounds.

        As if there were none, where that is within them; else along the eigenvectors of
        its precision. The first is exact, and whether it is chosen depends on no
        earlier u.
        """
        p, rng, free, mean = self.unknowns, self.rng, normal.free, normal.mean
        upper = np.swapaxes(np.linalg.cholesky(normal.precision), 1, 2)
        new = np.linalg.solve(upper, rng.standard_normal((*u.shape, 1)))[..., 0]
        new = np.where(free, mean + new, 0.0)
        out = np.flatnonzero(((new < p.low) | (new > p.high)).any(1))
        if not len(out):
            return new
        u, mean, free = np.where(free, u, 0.0)[out], mean[out], free[out]
        values, vectors = eigh(normal.precision[out])
        for j in range(u.shape[1]):
            is_along = free & (np.abs(vectors[:, :, j]) > 1e-12)
            e = np.where(is_along, vectors[:, :, j], 0.0)
            with np.errstate(divide="ignore", invalid="ignore"):
                ends = np.stack([(p.low - u) / e, (p.high - u) / e])
            ends = np.where(e == 0, np.array([-np.inf, np.inf])[:, None, None], ends)
            low = np.minimum(ends.min(0).max(1), 0.0)
            high = np.maximum(ends.max(0).min(1), 0.0)
            off = (e * (mean - u)).sum(1)  # along it u is independent of all others
            step = truncated_normal(off, values[:, j] ** -0.5, low, high, rng)
            moved = u + np.where(e.any(1), step, 0.0)[:, None] * e
            u = np.clip(moved, p.low, p.high)
        new[out] = np.where(free, u, 0.0)
        return new


@dataclass(frozen=True)
class _Normal:
    """Gaussians of u, n of them, without bounds.

    Attributes:
        precision: Precision of what is free, and one of what is zero, (n, d, d).
        linear: Precision times mean, shape (n, d).
        unknowns: Bounds, within which u has its evidence.
        free: Coordinates that are not zero, shape (n, d).
    """

    precision: Array
    linear: Array
    unknowns: Unknowns
    free: Flags

    def given(self, free: Flags) -> _Normal:
        """Return them with some coordinates alone, the others being zero."""
        eye, both = np.eye(free.shape[1]), free[:, :, None] & free[:, None]
        precision = np.where(both, self.precision, eye)
        return _Normal(precision, np.where(free, self.linear, 0.0), self.unknowns, free)

    @cached_property
    def cov(self) -> Array:
        """Covariances, shape (n, d, d)."""
        return np.linalg.inv(self.precision)

    @property
    def mean(self) -> Array:
        """Means, shape (n, d)."""
        return (self.cov @ self.linear[..., None])[..., 0]

    @property
    def log_evidence(self) -> Array:
        """Log evidence of what is free, up to what all share, (n,)."""
        p, mean = self.unknowns, self.mean
        some = np.isfinite(p.low) | np.isfinite(p.high)
        sd = np.sqrt(np.einsum("nii->ni", self.cov)[:, some])
        inside = log_inside(mean[:, some], sd, p.low[some], p.high[some])
        log_z = np.where(self.free[:, some], inside, 0.0).sum(1)
        log_det = np.linalg.slogdet(self.precision)[1]
        return log_z + 0.5 * ((self.linear * mean).sum(1) - log_det)
