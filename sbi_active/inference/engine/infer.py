"""The posterior of a potential, in one way: search, importance sampling, SMC.

1. Gauss-Newton searches find the modes and their widths.
2. Importance sampling from a mixture around these and the prior, which is fitted to the
   draws again and again; where too few count, the likelihood is tempered.
3. Where enough draws are effective, that is the posterior; another proposal is fitted
   while few of them outweigh all others. Otherwise particles are led from the modes to
   it by sequential Monte Carlo, whose cost grows little with the number of parameters.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from sbi_active.inference.engine.importance import (
    fitted,
    importance_sample,
    pareto_shape,
    wider,
)
from sbi_active.inference.engine.particles import (
    fit_of,
    led_particles,
    share_cut,
    uninformed,
)
from sbi_active.inference.engine.pool import Fit, Pool, PriorDraws
from sbi_active.inference.engine.potential import Density, Potential
from sbi_active.inference.engine.search import WIDER, Found
from sbi_active.inference.engine.settings import Settings
from sbi_active.inference.sampling.student_mixture import (
    Defended,
    Proposal,
    StudentMixture,
)
from sbi_active.inference.sampling.weights import normalized

Array = NDArray[Any]


def infer(
    potential: Density,
    rng: np.random.Generator,
    *,
    found: Found | None = None,
    past: Pool | None = None,
    near: Array | None = None,
    settings: Settings = Settings(),  # noqa: B008  (frozen)
) -> Fit:
    """Return the posterior of a potential.

    Args:
        potential: Log density of the parameters given all trials, with residuals where
            modes of it were found.
        rng: Source of the draws.
        found: Modes of the potential; None if a search got nowhere.
        past: Draws for the first of these trials, with the likelihood of all, to which
            are added.
        near: Draws of a guess, shape (n, d), looked at where the modes do not suffice.
        settings: Numbers of draws, and what decides between the ways.
    """
    none = np.zeros(potential.dim, dtype=bool)
    searched = cast(Potential, potential)  # where modes were found
    if past is None:
        free = none if found is None else uninformed(found, searched, rng)
        if found is not None and (
            free.any() or share_cut(searched, found) > settings.hopeless
        ):
            moved = led_particles(searched, found, free, rng, settings)
            if moved is not None:
                return fit_of(moved, searched, found, free, rng, settings)
        pool = Pool.empty(potential.dim, potential.num_trials)
        _begin(pool, potential, rng, found, near, settings)
    else:
        pool = past
        if found is not None:
            _go_on(pool, searched, rng, found, settings)
    num_modes = 0 if found is None else len(found.modes)
    rough = importance_sample(
        pool,
        potential,
        rng,
        num_components=max(settings.num_components, num_modes),
        settings=settings,
        # After a further trial the modes are not all, and the draws may know others.
        found=found if past is None else None,
    )
    final, effective = pool.is_final, pool.effective_sample_size
    wanted = settings.asked(potential.dim, is_cheap=False)
    if found is not None and past is None and effective < wanted:
        moved = led_particles(searched, found, none, rng, settings)
        if moved is not None and moved.effective_sample_size > effective:
            return fit_of(moved, searched, found, none, rng, settings)
    return Fit(
        u=pool.u[final],
        weight=normalized(pool.log_weight[final]) if final.any() else np.zeros(0),
        log_likelihood=pool.log_likelihood[final],
        log_evidence=pool.log_evidence,
        standard_error=pool.standard_error,
        effective_sample_size=effective,
        tail_shape=pareto_shape(pool.log_weight[final]) if final.any() else np.inf,
        method="importance",
        is_rough=rough,
        free=none,
        found=found,
        pool=pool,
    )


def _begin(
    pool: Pool,
    potential: Density,
    rng: np.random.Generator,
    found: Found | None,
    near: Array | None,
    settings: Settings,
) -> None:
    """Add draws of the prior and around the modes; more where these do not count."""
    prior = PriorDraws(potential)
    if found is not None:
        pool.add(prior, found.screened, potential)  # simulated for the search already
        pool.restart()
        first = _around(found, cast(Potential, potential), settings)
        pool.add(first, first.sample(settings.num_draws, rng), potential)
        effective = pool.effective_sample_size
        if effective >= settings.fewest or settings.affords(
            effective, pool.num_final, settings.num_effective
        ):
            return
    if near is not None and len(near) > 2 * potential.dim:
        weight = np.full(len(near), 1 / len(near))
        own = fitted(near, weight, settings.num_components, settings, rng)
        pool.add(own, own.sample(settings.num_draws, rng), potential)
    num = int(1.5 * settings.num_draws)
    pool.add(prior, prior.sample(num, rng), potential)


def _go_on(
    pool: Pool,
    potential: Potential,
    rng: np.random.Generator,
    found: Found,
    settings: Settings,
) -> None:
    """Add draws of the modes that were found, and of what the pool says."""
    first: Proposal = _around(found, potential, settings)
    weight = normalized(pool.log_mixture_weight)
    if len(pool.u) and 1 / float((weight**2).sum()) > 2 * potential.dim + 2:
        own = fitted(pool.u, weight, settings.num_components, settings, rng)
        first = Defended(first, own, 0.5)
    pool.add(first, first.sample(settings.num_draws, rng), potential)


def _around(found: Found, potential: Potential, settings: Settings) -> StudentMixture:
    r"""Return a mixture around the modes, as wide on each side as the density is.

    Along each axis of a mode's normal approximation, of unit length there, within
    bounds,

    .. math::
        s = \max_t \frac{t}{\sqrt{2 (\log p(m) - \log p(m + t a))}},

    which is 1 of a normal density, and more towards a shelf.
    """
    c, guess = potential.coordinates, found.guess
    k, d = found.modes.shape
    cov = guess.factors @ np.swapaxes(guess.factors, 1, 2) / WIDER**2
    values, vectors = np.linalg.eigh(cov)
    axes = vectors * np.sqrt(np.maximum(values, 1e-24))[:, None]
    length = np.abs(axes).max(1)  # (k, d), in deviations of the prior
    far = np.multiply.outer(settings.profiled, 1 / np.maximum(length[:k], 1e-12))
    near = np.multiply.outer(settings.profiled_near, np.ones((k, d)))
    steps = np.sort(np.concatenate([near, far]), axis=0)
    sides = np.stack([-steps, steps])  # (2, s, k, d)
    places = found.modes[:, None] + np.swapaxes(axes[:k], 1, 2) * sides[..., None]
    at = np.concatenate([found.modes, places.reshape(-1, d)])
    is_inside = np.all((at >= c.low) & (at <= c.high), axis=1)
    at = np.clip(at, c.low, c.high)
    log_p = potential.log_prior(at) + potential.log_likelihood(at)
    peak, log_p = log_p[:k, None], log_p[k:].reshape(sides.shape)
    # Residuals, which modes are of, say nothing of trials without an outcome, so that a
    # mode itself may be impossible: what is as impossible is no part of it.
    fall = np.full(sides.shape, np.inf)
    np.subtract(peak, log_p, out=fall, where=np.isfinite(log_p))
    fall = np.maximum(fall, 1e-2)
    # Beyond a valley there are other modes.
    within = np.maximum.accumulate(fall, axis=1) < settings.valley
    within &= is_inside[k:].reshape(sides.shape)
    within = np.concatenate([np.ones_like(within[:, :1]), within[:, 1:]], 1)
    width = np.where(within, np.abs(sides) / np.sqrt(2 * fall), 0.0).max(1)
    width = np.clip(width, 1.0, np.maximum(1 / np.maximum(length[:k], 1e-12), 1.0))
    others = np.ones((2, len(axes) - k, d))  # of another error, are no modes
    width = np.concatenate([width, others], 1)
    left, right = wider(settings.laplace_wider, d) * width
    freedom = max(settings.freedom, float(d))
    return StudentMixture(guess.means, axes, guess.weights, freedom, left, right)
