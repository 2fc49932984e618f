"""Particles that are led from the modes to the posterior."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.inference.engine.bounded import (
    LinearResponse,
    LineMoves,
    led_between,
)
from sbi_active.inference.engine.importance import fitted
from sbi_active.inference.engine.pool import Fit, Pool
from sbi_active.inference.engine.potential import Potential
from sbi_active.inference.engine.search import WIDER, Found
from sbi_active.inference.engine.settings import Settings
from sbi_active.inference.sampling.smc import Bridged, bridge
from sbi_active.inference.sampling.student_mixture import StudentMixture
from sbi_active.inference.sampling.weights import log_sum_exp

Array = NDArray[Any]


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
) -> float:
    r"""Return the prior's log density of the free coordinates at zero.

    Independent of the others, which stay at zero, it is

    .. math::
        p_F(0) = p(0) \Big/ \int p(0, u_F)\, du_F .
    """
    u = np.zeros((num, potential.dim))
    u[:, free] = WIDER * rng.standard_normal((len(u), int(free.sum())))
    square = ((u[:, free] / WIDER) ** 2 + np.log(2 * np.pi * WIDER**2)).sum(1)
    log_w = potential.log_prior(u) + 0.5 * square
    integral = log_sum_exp(log_w) - np.log(len(u))
    return float(potential.log_prior(u[:1] * 0)[0] - integral)
