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

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.identification.settings import SamplerSettings
from sbi_active.criticism.linear.processes import Grams, Processes
from sbi_active.inference.sampling.eigen import eigh
from sbi_active.inference.sampling.truncated import log_inside, truncated_normal

Array = NDArray[Any]
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


def sample(
    grams: Grams,
    processes: Processes,
    unknowns: Unknowns,
    known_size: list[float | None],
    rng: np.random.Generator,
    *,
    sweeps: int,
    settings: SamplerSettings = SamplerSettings(),  # noqa: B008  (frozen)
) -> Draws:
    """Return posterior draws of all chains.

    Args:
        grams: Gram matrices of (r_0, J), by channel.
        processes: Hypotheses of the errors, white noise first, of size one.
        unknowns: Priors of the unknowns.
        known_size: Deviation of the white part by channel; None if it is unknown.
        rng: Source of the draws.
        sweeps: Sweeps of each chain, after those that are left out.
        settings: Numbers of draws, and priors.
    """
    p, num, d = unknowns, settings.chains, len(unknowns.low)
    ridge = p.precision + settings.flat / (p.high - p.low) ** 2
    shapes = max(len(processes) - 1, 1)
    log_prior = np.full(len(processes), np.log((1 - settings.absent) / shapes))
    log_prior[0] = np.log(settings.absent)
    u = np.clip(np.zeros((num, d)), p.low, p.high)
    present = np.ones((num, p.num_effects), dtype=bool)
    kept: list[tuple[Array, ...]] = []
    for sweep in range(settings.burnt + sweeps):
        precision = np.broadcast_to(np.diag(ridge), (num, d, d)).copy()
        linear = np.broadcast_to(p.precision * p.center, (num, d)).copy()
        chosen, sizes = [], []
        for c, size in enumerate(known_size):
            own = grams.gram[:, c], grams.log_det[:, c], int(grams.count[c])
            h, variance = _errors(*own, processes, log_prior, size, u, rng)
            gram = own[0][h] / variance[:, None, None]
            precision += gram[:, 1:, 1:]
            linear -= gram[:, 1:, 0]
            chosen.append(h)
            sizes.append(np.sqrt(variance))
        given = _Given(precision, linear, p)
        present = _present(given, present, settings.absent, rng)
        u = _moved(given, present, u, rng)
        if sweep >= settings.burnt:
            parts = (u, present, np.stack(chosen, 1), np.stack(sizes, 1))
            kept.append(tuple(part.copy() for part in parts))
    return Draws(*(np.concatenate(part) for part in zip(*kept, strict=True)))


def _errors(
    gram: Array,
    log_det: Array,
    count: int,
    processes: Processes,
    log_prior: Array,
    size: float | None,
    u: Array,
    rng: np.random.Generator,
) -> tuple[NDArray[np.intp], Array]:
    """Return the shape and the variance of one channel's errors, given u."""
    one = np.concatenate([np.ones((len(u), 1)), u], 1)
    square = (one[:, :, None] * one[:, None]).reshape(len(u), -1)
    square = np.maximum(square @ gram.reshape(len(gram), -1).T, TINY)
    log_p = log_prior - 0.5 * log_det
    if size is None:  # with the variance summed out, p(v) = 1 / v
        log_p = log_p - 0.5 * count * np.log(square)
    else:
        every = size**2 / processes.white
        log_p = log_p - 0.5 * (square / every + count * np.log(every))
    h = np.argmax(log_p + rng.gumbel(size=log_p.shape), axis=1)  # of softmax
    if size is not None:
        return h, size**2 / processes.white[h]
    return h, square[np.arange(len(u)), h] / (2 * rng.gamma(0.5 * count, size=len(u)))


@dataclass(frozen=True)
class _Given:
    """Gaussians of u given the errors, without bounds.

    Attributes:
        precision: Precision of all of u, shape (n, d, d).
        linear: Precision times mean, shape (n, d).
        prior: Prior knowledge of u.
    """

    precision: Array
    linear: Array
    prior: Unknowns

    def where(self, present: Flags) -> tuple[Flags, Array, Array, Array]:
        """Return what is free where some effects are there, and its distribution.

        Returns:
            Mask of what is free, its precision (ones elsewhere) and mean, and the log
            evidence up to what all share; shapes (n, d), (n, d, d), (n, d) and (n,).
        """
        p, there = self.prior, np.ones((len(present), 1), dtype=bool)
        free = np.concatenate([present, there], 1)[:, p.effect]
        both = free[:, :, None] & free[:, None]
        precision = np.where(both, self.precision, np.eye(free.shape[1]))
        cov = np.linalg.inv(precision)
        linear = np.where(free, self.linear, 0.0)
        mean = (cov @ linear[:, :, None])[..., 0]
        some = np.isfinite(p.low) | np.isfinite(p.high)
        sd = np.sqrt(np.einsum("nii->ni", cov)[:, some])
        inside = log_inside(mean[:, some], sd, p.low[some], p.high[some])
        log_z = np.where(free[:, some], inside, 0.0).sum(1)
        log_z += 0.5 * ((linear * mean).sum(1) - np.linalg.slogdet(precision)[1])
        return free, precision, mean, log_z


def _present(
    given: _Given, present: Flags, absent: float, rng: np.random.Generator
) -> Flags:
    """Return the effects that are there, one after the other given all others.

    Args:
        given: Gaussians given the errors.
        present: Mask of the effects that are there so far, shape (n, e).
        absent: Prior probability that none is there.
        rng: Source of the draws.
    """
    p, num = given.prior, max(present.shape[1], 1)
    log_odds = np.log(absent ** (-1 / num) - 1) + p.log_density
    log_z = given.where(present)[-1]
    for e in rng.permutation(p.num_effects):
        other = present.copy()
        other[:, e] ^= True
        log_other = given.where(other)[-1]
        gain = log_other - log_z + np.where(other[:, e], 1, -1) * log_odds[e]
        flip = rng.logistic(size=len(gain)) < gain
        present = np.where(flip[:, None], other, present)
        log_z = np.where(flip, log_other, log_z)
    return present


def _moved(given: _Given, present: Flags, u: Array, rng: np.random.Generator) -> Array:
    """Return u drawn within its bounds.

    As if there were none, where that is within them; else along the eigenvectors of its
    precision. The first is exact, and whether it is chosen depends on no earlier u.
    """
    p = given.prior
    free, precision, mean, _ = given.where(present)
    upper = np.swapaxes(np.linalg.cholesky(precision), 1, 2)
    new = np.linalg.solve(upper, rng.standard_normal((*u.shape, 1)))[..., 0]
    new = np.where(free, mean + new, 0.0)
    out = np.flatnonzero(((new < p.low) | (new > p.high)).any(1))
    if not len(out):
        return new
    u, mean, free = np.where(free, u, 0.0)[out], mean[out], free[out]
    values, vectors = eigh(precision[out])
    sd = 1 / np.sqrt(values)
    for j in range(u.shape[1]):
        e = np.where(free & (np.abs(vectors[:, :, j]) > 1e-12), vectors[:, :, j], 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(p.low - u) / e, (p.high - u) / e])
        ends = np.where(e == 0, np.array([-np.inf, np.inf])[:, None, None], ends)
        low = np.minimum(ends.min(0).max(1), 0.0)
        high = np.maximum(ends.max(0).min(1), 0.0)
        off = (e * (mean - u)).sum(1)  # along it u is independent of all others
        step = truncated_normal(off, sd[:, j], low, high, rng)
        u = np.clip(u + np.where(e.any(1), step, 0.0)[:, None] * e, p.low, p.high)
    new[out] = np.where(free, u, 0.0)
    return new
