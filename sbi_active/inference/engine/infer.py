"""The posterior of a potential, in one way: search, importance sampling, SMC.

1. Gauss-Newton searches find the modes and their widths.
2. Importance sampling from a mixture around these and the prior, which is fitted to the
   draws again and again; where too few count, the likelihood is tempered.
3. Where enough draws are effective, that is the posterior; another proposal is fitted
   while few of them outweigh all others. Otherwise particles are led from the modes to
   it by sequential Monte Carlo, whose cost grows little with the number of parameters.
"""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.inference.engine.bounded import LinearResponse, LineMoves, led_between
from sbi_active.inference.engine.importance import (
    fitted,
    importance_sample,
    pareto_shape,
    wider,
)
from sbi_active.inference.engine.pool import Fit, Pool, PriorDraws
from sbi_active.inference.engine.potential import Density, Potential
from sbi_active.inference.engine.search import Found
from sbi_active.inference.engine.settings import Settings
from sbi_active.inference.sampling.mixtures import Defended, Proposal, StudentMixture
from sbi_active.inference.sampling.smc import Bridged, bridge
from sbi_active.inference.sampling.weights import log_sum_exp, normalized


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
    cov = guess.factors @ np.swapaxes(guess.factors, 1, 2) / found.wider**2
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


def uninformed(
    found: Found,
    potential: Potential,
    rng: np.random.Generator,
    *,
    unchanged: float = 2e-3,
    num: int = 16,
) -> NDArray[np.bool_]:
    """Return parameters that change no trial and do not depend on others.

    Single precision may change a residual by ``unchanged`` deviations of the noise.
    """
    free = ~found.informed
    none = np.zeros(potential.dim, dtype=bool)
    if not free.any() or free.all():
        return none
    drawn, other = (potential.sample_prior(num, rng) for _ in range(2))
    c = potential.coordinates
    near, off = (np.clip(found.guess.sample(num, rng), c.low, c.high) for _ in range(2))

    def changes(axes: NDArray[np.bool_]) -> bool:
        pairs = (drawn, np.where(axes, other, drawn)), (near, np.where(axes, off, near))
        residuals = (
            np.abs(potential.residual(a)[0] - potential.residual(b)[0])
            for a, b in pairs
        )
        return any(r.max() > unchanged for r in residuals)

    for axis in np.flatnonzero(free):
        free[axis] = not changes(np.arange(potential.dim) == axis)
    is_free = free.any() and potential.splits_off(free, rng) and not changes(free)
    return free if is_free else none


def share_cut(potential: Potential, found: Found, *, num: int = 500) -> float:
    """Return the share of the modes' normal approximations beyond the bounds."""
    c, rng = potential.coordinates, np.random.default_rng(0)
    drawn = found.guess.sample(num, rng)
    return float(((drawn < c.low) | (drawn > c.high)).any(1).mean())


def led_particles(
    potential: Potential,
    found: Found,
    free: NDArray[np.bool_],
    rng: np.random.Generator,
    settings: Settings,
    *,
    widths: tuple[tuple[float, float], ...] = ((1.0, 0.4), (2.0, 0.3), (3.0, 0.3)),
) -> Bridged | None:
    """Return particles of all parameters; only those that trials inform are moved."""
    guess, axes = found.guess, np.flatnonzero(~free)
    cov = guess.factors @ np.swapaxes(guess.factors, 1, 2)
    factors = np.linalg.cholesky(cov[:, axes[:, None], axes])
    # Tails that bend away from the normal of a mode are out of its own reach.
    own = StudentMixture(
        np.concatenate([guess.means[:, axes]] * len(widths)),
        np.concatenate([factors * width for width, _ in widths]),
        np.concatenate([guess.weights * weight for _, weight in widths]),
        np.inf,
    )
    rest = np.zeros((1, potential.dim))

    def whole(u: Array) -> Array:
        full = np.repeat(rest, len(u), 0)
        full[:, axes] = u
        return full

    fixed = _log_free(potential, free, rng) if free.any() else 0.0
    num = int(settings.per_parameter * len(axes) * settings.num_effective)
    most = settings.budget(len(axes)) / potential.num_trials
    num = max(int(min(num, most / settings.passes)), settings.fewest_particles)

    def log_prior(u: Array) -> Array:
        return potential.log_prior(whole(u)) - fixed

    def log_likelihood(u: Array) -> Array:
        return potential.log_likelihood(whole(u))

    c = potential.coordinates
    drawn = own.sample(num, rng)
    cut = (drawn < c.low[axes]) | (drawn > c.high[axes])
    if cut.any(1).mean() < settings.most_cut:
        moved = bridge(
            log_prior, log_likelihood, own, rng, num_particles=num, most=most
        )
    else:
        low, high = c.low[axes], c.high[axes]
        response = LinearResponse(potential, found, axes)
        moved = None
        # Far from what is linear the rows may suffice for fewer.
        for few in dict.fromkeys((num, max(num // 4, settings.fewest_particles))):
            moved = moved or led_between(
                log_prior,
                log_likelihood,
                response,
                LineMoves(response, low, high, c.precision[axes]),
                np.clip(potential.sample_prior(few, rng)[:, axes], low, high),
                rng,
                most=most,
            )
    if moved is None:
        return None
    u = moved.u
    if free.any():
        u = potential.sample_prior(len(moved.u), rng)
        u[:, axes] = moved.u
    rows = np.isfinite(potential.log_prior(u))
    return replace(moved, u=u[rows], log_likelihood=moved.log_likelihood[rows])


def fit_of(
    moved: Bridged,
    potential: Potential,
    found: Found,
    free: NDArray[np.bool_],
    rng: np.random.Generator,
    settings: Settings,
) -> Fit:
    """Return the posterior that particles were led to."""
    n = len(moved.u)
    return Fit(
        u=moved.u,
        weight=np.full(n, 1 / n),
        log_likelihood=moved.log_likelihood,
        log_evidence=moved.log_evidence,
        standard_error=moved.standard_error,
        effective_sample_size=moved.effective_sample_size,
        method="smc",
        free=free,
        found=found,
        particles=moved,
        pool=_as_pool(moved, potential, settings, rng),
    )


def _as_pool(
    particles: Bridged,
    potential: Potential,
    settings: Settings,
    rng: np.random.Generator,
) -> Pool:
    """Return particles as draws of a mixture that is fitted to them."""
    n = len(particles.u)
    own = fitted(particles.u, np.full(n, 1 / n), settings.num_components, settings, rng)
    # As many as there are, with the weights that their evidence asks for.
    log_prior = potential.log_prior(particles.u)
    log_own = log_prior + particles.log_likelihood - particles.log_evidence
    return Pool(
        particles.u,
        log_prior,
        particles.log_likelihood,
        log_own + np.log(n),
        log_own,
        np.ones(n, dtype=bool),
        n,
        [(n, own)],
        potential.num_trials,
        np.zeros(n),
    )


def _log_free(
    potential: Potential,
    free: NDArray[np.bool_],
    rng: np.random.Generator,
    *,
    num: int = 4_000,
    wider: float = 1.1,
) -> float:
    r"""Return the prior's log density of the free coordinates at zero.

    Independent of the others, which stay at zero, it is

    .. math::
        p_F(0) = p(0) \Big/ \int p(0, u_F)\, du_F ,

    by draws from a normal density a little wider than the prior.
    """
    u = np.zeros((num, potential.dim))
    u[:, free] = wider * rng.standard_normal((len(u), int(free.sum())))
    square = ((u[:, free] / wider) ** 2 + np.log(2 * np.pi * wider**2)).sum(1)
    log_w = potential.log_prior(u) + 0.5 * square
    integral = log_sum_exp(log_w) - np.log(len(u))
    return float(potential.log_prior(u[:1] * 0)[0] - integral)
