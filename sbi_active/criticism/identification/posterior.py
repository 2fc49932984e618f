r"""Draws of parameters of a linear model with unknown errors and doubtful effects.

.. math::
    r(u) = r_0 + J u, \qquad r_c \sim \mathcal N(0, \sigma_c^2 C_{h_c})

in every channel c, with u = (theta, phi) between bounds. An effect is absent, phi at
its null, unless it is there: what may be missing widens the intervals by as much as the
logs leave it open, and hardly where they exclude it. Blocks of the Gibbs sampler are
the errors' shape and size by channel, each effect's presence with all of u summed out,
and u along the eigenvectors of its precision.

References:
    George & McCulloch, Statistica Sinica 7 (1997), for the presence of variables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.identification.errors import Grams, Hypotheses
from sbi_active.inference.sampling.eigen import eigh
from sbi_active.inference.sampling.truncated import log_inside, truncated_normal

Array = NDArray[Any]

#: Chains, and the sweeps that are left out of them.
CHAINS, BURNT = 64, 15
#: Prior probability that no doubtful effect is there.
NONE = 0.5
TINY = 1e-300


@dataclass(frozen=True)
class Unknowns:
    """What is known of u before the logs, d coordinates from where they are zero.

    Attributes:
        low: Shape (d,).
        high: Shape (d,).
        center: Of a Gaussian prior, shape (d,).
        precision: Of it, 0 for uniform ones, shape (d,).
        null: Of effects, shape (d,); 0 for others.
        effect: Number of the effect that a coordinate belongs to, -1 for theta, (d,).
    """

    low: Array
    high: Array
    center: Array
    precision: Array
    null: Array
    effect: NDArray[np.int64]

    @property
    def num_effects(self) -> int:
        """Number of doubtful effects."""
        return int(self.effect.max(initial=-1)) + 1


@dataclass(frozen=True)
class Draws:
    """Of the posterior.

    Attributes:
        u: Shape (n, d).
        present: Whether each effect is there, bool, shape (n, e).
        errors: Hypothesis of each channel, shape (n, c).
        size: Deviation of each channel's errors, shape (n, c).
    """

    u: Array
    present: NDArray[np.bool_]
    errors: NDArray[np.int64]
    size: Array

    @classmethod
    def none(cls, dim: int) -> Draws:
        """Return no draws of u with d coordinates."""
        shape, whole = (0, 0), np.empty((0, 0), dtype=np.int64)
        return cls(np.empty((0, dim)), np.empty(shape, dtype=bool), whole, whole * 1.0)


def sample(
    channels: Sequence[Grams],
    hypotheses: Hypotheses,
    unknowns: Unknowns,
    known_size: Sequence[float | None],
    rng: np.random.Generator,
    *,
    sweeps: int,
) -> Draws:
    """Return posterior draws, of 64 chains.

    Args:
        channels: Gram matrices of (r_0, J) by channel.
        hypotheses: Of the errors.
        unknowns: Priors.
        known_size: Deviation of the white part by channel; None where it is unknown.
        rng: Source of the draws.
        sweeps: Of each chain, after those that are left out.
    """
    p, d = unknowns, len(unknowns.low)
    sums = [g.total for g in channels]
    u = np.clip(np.zeros((CHAINS, d)), p.low, p.high)
    present = np.ones((CHAINS, p.num_effects), dtype=bool)
    kept: list[tuple[Array, ...]] = []
    for sweep in range(BURNT + sweeps):
        precision = np.zeros((CHAINS, d, d))
        linear = np.zeros((CHAINS, d))
        chosen, sizes = [], []
        for (gram, log_det, count), size in zip(sums, known_size, strict=True):
            h, variance = _errors(gram, log_det, count, hypotheses, size, u, rng)
            precision += gram[h][:, 1:, 1:] / variance[:, None, None]
            linear -= gram[h][:, 1:, 0] / variance[:, None]
            chosen.append(h)
            sizes.append(np.sqrt(variance))
        present = _present(precision, linear, p, present, rng)
        u = _moved(u, precision, linear, p, present, rng)
        if sweep >= BURNT:
            parts = (u, present, np.stack(chosen, 1), np.stack(sizes, 1))
            kept.append(tuple(part.copy() for part in parts))
    return Draws(*(np.concatenate(part) for part in zip(*kept, strict=True)))


def _errors(
    gram: Array,
    log_det: Array,
    count: int,
    hypotheses: Hypotheses,
    size: float | None,
    u: Array,
    rng: np.random.Generator,
) -> tuple[NDArray[np.intp], Array]:
    """Return the shape and the variance of one channel's errors, given u."""
    one = np.concatenate([np.ones((len(u), 1)), u], 1)
    square = np.einsum("ni,hij,nj->nh", one, gram, one, optimize=True)
    square = np.maximum(square, TINY)
    log_p = hypotheses.log_prior - 0.5 * log_det
    if size is None:  # with the variance summed out, p(v) = 1 / v
        log_p = log_p - 0.5 * count * np.log(square)
    else:
        every = size**2 / hypotheses.share
        log_p = log_p - 0.5 * (square / every + count * np.log(every))
    h = _picked(log_p, rng)
    if size is not None:
        return h, size**2 / hypotheses.share[h]
    rows = np.arange(len(u))
    return h, square[rows, h] / (2 * rng.gamma(0.5 * count, size=len(u)))


def _present(
    precision: Array,
    linear: Array,
    p: Unknowns,
    present: NDArray[np.bool_],
    rng: np.random.Generator,
) -> NDArray[np.bool_]:
    """Return which effects are there, one after the other given all others."""
    if not p.num_effects:
        return present
    present = present.copy()
    absent = NONE ** (1 / p.num_effects)
    log_odds = np.log1p(-absent) - np.log(absent)
    log_z = _log_evidence(precision, linear, p, present)
    for e in rng.permutation(p.num_effects):
        other = present.copy()
        other[:, e] = ~present[:, e]
        log_other = _log_evidence(precision, linear, p, other)
        gain = log_other - log_z + np.where(other[:, e], log_odds, -log_odds)
        flip = rng.random(len(gain)) < 1 / (1 + np.exp(np.clip(-gain, -700, 700)))
        present[flip, e] = other[flip, e]
        log_z = np.where(flip, log_other, log_z)
    return present


def _conditional(
    precision: Array, linear: Array, p: Unknowns, present: NDArray[np.bool_]
) -> tuple[Array, Array, NDArray[np.bool_], Array]:
    """Return what is free given what is absent: precision, linear part, mask, rest.

    Coordinates that are absent have a precision of one apart from all others, and stand
    at their null; ``rest`` is the log density that these have.
    """
    free = np.ones((len(linear), len(p.low)), dtype=bool)
    own = p.effect >= 0
    free[:, own] = present[:, p.effect[own]]
    absent = np.where(free, 0.0, p.null)
    at_null = np.einsum("nij,nj->ni", precision, absent)
    rest = (absent * (linear - 0.5 * at_null)).sum(1)
    full = precision * (free[:, :, None] & free[:, None, :])
    full = full + np.where(free, p.precision, 1.0)[:, None] * np.eye(len(own))
    rhs = np.where(free, linear - at_null + p.precision * p.center, 0.0)
    # An effect's prior is a normalized density; theta is in every model.
    log_prior = 0.5 * np.log(np.maximum(p.precision, TINY))
    log_prior = log_prior - 0.5 * p.precision * p.center**2
    scale = 1 / np.sqrt(np.maximum(p.precision, TINY))
    log_prior = log_prior - log_inside(p.center, scale, p.low, p.high)
    rest = rest + (np.where(own, log_prior, 0.0) * free).sum(1)
    return full, rhs, free, rest


def _log_evidence(
    precision: Array, linear: Array, p: Unknowns, present: NDArray[np.bool_]
) -> Array:
    """Return the log evidence of which effects are there, up to what all share."""
    full, rhs, free, rest = _conditional(precision, linear, p, present)
    ridge = 1e-10 * np.einsum("nii->ni", full)[:, :, None] * np.eye(len(p.low))
    cov = np.linalg.inv(full + ridge)
    mean = np.einsum("nij,nj->ni", cov, rhs)
    sd = np.sqrt(np.maximum(np.einsum("nii->ni", cov), TINY))
    inside = log_inside(mean, sd, p.low, p.high)
    log_z = rest + 0.5 * (mean * rhs).sum(1) + 0.5 * np.linalg.slogdet(cov)[1]
    return log_z + np.where(free, inside, 0.0).sum(1)


def _moved(
    u: Array,
    precision: Array,
    linear: Array,
    p: Unknowns,
    present: NDArray[np.bool_],
    rng: np.random.Generator,
) -> Array:
    """Return u drawn along the eigenvectors of its precision, within its bounds."""
    full, rhs, free, _ = _conditional(precision, linear, p, present)
    u = np.where(free, u, p.null)
    values, vectors = eigh(full)
    for j in range(u.shape[1]):
        e = np.where(free, vectors[:, :, j], 0.0)
        e = np.where(np.abs(e) < 1e-12, 0.0, e)
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(p.low - u) / e, (p.high - u) / e])
        ends = np.where(e == 0, np.array([-np.inf, np.inf])[:, None, None], ends)
        low = np.minimum(ends.min(0).max(1), 0.0)
        high = np.maximum(ends.max(0).min(1), 0.0)
        slope = (e * (rhs - np.einsum("nij,nj->ni", full, np.where(free, u, 0)))).sum(1)
        sd = 1 / np.sqrt(np.maximum(values[:, j], 1e-12))
        step = truncated_normal(slope * sd**2, sd, low, high, rng)
        step = np.where((e != 0).any(1), step, 0.0)
        u = np.clip(u + step[:, None] * e, p.low, p.high)
        u = np.where(free, u, p.null)
    return u


def _picked(log_p: Array, rng: np.random.Generator) -> NDArray[np.intp]:
    p = np.exp(log_p - log_p.max(1, keepdims=True))
    steps = np.cumsum(p, 1)
    place = (steps < rng.random((len(p), 1)) * steps[:, -1:]).sum(1)
    return np.minimum(place, p.shape[1] - 1)
