"""The posterior of a potential, in one way: search, importance sampling, SMC.

1. Gauss-Newton searches find the modes and their widths.
2. Importance sampling from a mixture around these and the prior, which is fitted to the
   draws again and again; where too few count, the likelihood is tempered.
3. Where enough draws are effective, that is the posterior; another proposal is fitted
   while few of them outweigh all others. Otherwise particles are led from the modes to
   it by sequential Monte Carlo, whose cost grows little with the number of parameters.

A model far behind another is known well enough by the Laplace approximation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.inference.engine.importance import (
    Pool,
    PriorDraws,
    fitted,
    importance_sample,
    pareto_shape,
    wider,
)
from sbi_active.inference.engine.potential import Potential
from sbi_active.inference.engine.search import WIDER, Found
from sbi_active.inference.engine.settings import Settings
from sbi_active.inference.sampling.smc import Bridged, bridge
from sbi_active.inference.sampling.student_mixture import (
    Defended,
    NormalMixture,
    Proposal,
    SplitStudentMixture,
)
from sbi_active.inference.sampling.weights import log_sum_exp, normalized

Array = NDArray[Any]

WIDTHS = ((1.0, 0.4), (2.0, 0.3), (3.0, 0.3))  # of the guess, and their weights
NUM_INTEGRAL = 4_000  # draws, which cost no simulation
UNCHANGED = 2e-3  # deviations of the noise, which single precision may change
NUM_PROBES = 16  # draws at which uninformed parameters are changed


@dataclass(frozen=True, kw_only=True)
class WeightedDraws:
    """Weighted draws of a posterior, with its evidence.

    Attributes:
        u: Draws in the potential's coordinates, shape (n, d).
        weight: Their weights, which sum to 1, shape (n,).
        log_evidence: Log of the integral of prior times likelihood, nats.
        standard_error: Standard error of log_evidence, nats.
        effective_sample_size: Number of draws that count.
        method: What gave the draws, "importance", "smc" or "laplace".
    """

    u: Array
    weight: Array
    log_evidence: float
    standard_error: float
    effective_sample_size: float
    method: str

    def draws(self, num: int, rng: np.random.Generator) -> Array:
        """Return equally weighted draws, shape (num, d)."""
        return self.u[rng.choice(len(self.u), num, p=self.weight)]


@dataclass(frozen=True, kw_only=True)
class Fit(WeightedDraws):
    """The posterior of a potential.

    Attributes:
        log_likelihood: Log likelihood of each draw, shape (n,).
        tail_shape: Shape of the tail of the weights; NaN of particles.
        is_rough: Whether the likelihood had to be tempered often.
        free: Parameters that keep their prior, shape (d,).
        found: What the search found; None where it got nowhere.
        particles: What moved them; None of importance sampling.
        pool: Draws to go on from after a further trial.
    """

    log_likelihood: Array
    tail_shape: float
    is_rough: bool
    free: NDArray[np.bool_]
    found: Found | None
    particles: Bridged | None
    pool: Pool


def infer(
    potential: Potential,
    rng: np.random.Generator,
    *,
    found: Found | None = None,
    past: Pool | None = None,
    near: Array | None = None,
    rivaled: float = -np.inf,
    settings: Settings = Settings(),  # noqa: B008  (frozen)
) -> Fit:
    """Return the posterior of a potential.

    Args:
        potential: Log density of the parameters given all trials.
        rng: Source of the draws.
        found: Modes of the potential; None where a search got nowhere.
        past: Draws for the first of these trials, with the likelihood of all, to which
            are added.
        near: Draws of a guess, shape (n, d), looked at where the modes do not suffice.
        rivaled: Log evidence of a better model: one that is far behind it need not be
            known as well.
        settings: Numbers of draws, and what decides between the ways.
    """
    none = np.zeros(potential.dim, dtype=bool)
    if found is not None and past is None:
        fit = _if_far_behind(potential, found, rivaled, rng, settings)
        if fit is not None:
            return fit
    if past is None:
        free = none if found is None else _free(found, potential, rng)
        if found is not None and free.any():
            moved = _particles(potential, found, free, rng, settings)
            if moved is not None:
                return _of_particles(moved, potential, found, free, rng, settings)
        pool = Pool.empty(potential.dim, potential.num_trials)
        _begin(pool, potential, rng, found, near, settings)
    else:
        pool = past
        if found is not None:
            _go_on(pool, potential, rng, found, settings)
    num_modes = 0 if found is None else len(found.modes)
    rough = importance_sample(
        pool,
        potential,
        rng,
        num_components=max(settings.num_components, num_modes),
        settings=settings,
        # After a further trial the modes are not all, and the draws may know others.
        found=found if past is None else None,
        rivaled=rivaled,
    )
    final, effective = pool.is_final, pool.effective_sample_size
    asked = settings.asked(potential.dim, is_cheap=False)
    wanted = settings.num_wanted(asked, pool.at_most - rivaled)
    # An evidence is an average of likelihoods.
    matters = pool.log_likelihood.max(initial=-np.inf) >= rivaled - settings.behind
    if found is not None and past is None and matters and effective < wanted:
        moved = _particles(potential, found, none, rng, settings)
        if moved is not None and moved.effective_sample_size > effective:
            return _of_particles(moved, potential, found, none, rng, settings)
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
        particles=None,
        pool=pool,
    )


def _if_far_behind(
    potential: Potential,
    found: Found,
    rivaled: float,
    rng: np.random.Generator,
    settings: Settings,
) -> Fit | None:
    r"""Return Laplace's evidence where it decides nothing, the mode first of the draws.

    .. math::
        \log Z \approx \log \sum_k p(x | u_k)\, p(u_k)\, \sqrt{|2 \pi \Sigma_k|}

    None unless even the largest likelihood, of which an evidence is an average, is
    below the rival's, and this far below. Draws are not simulated, and count as less
    likely than the mode.

    References:
        Kass & Raftery, Journal of the American Statistical Association 90 (1995).
    """
    modes, dim = found.modes, potential.dim
    if not (np.isfinite(rivaled) and potential.searched.all()):
        return None  # the error's own coordinates are where they were
    log_likelihood = potential.log_likelihood(modes)
    if not log_likelihood.max() < rivaled:
        return None
    factors = found.guess.factors[: len(modes)] / WIDER
    volume = np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(1)
    mass = log_likelihood + potential.log_prior(modes) + volume
    log_z = float(log_sum_exp(mass) + 0.5 * dim * np.log(2 * np.pi))
    if not -np.inf < log_z < rivaled - settings.far_behind:
        return None
    c, none = potential.coordinates, np.zeros(dim, dtype=bool)
    normal = rng.standard_normal((settings.num_draws, dim))
    u = np.clip(modes[0] + normal @ factors[0].T, c.low, c.high)
    # A bound itself may round to beyond.
    u = np.concatenate([modes[:1], u[np.isfinite(potential.log_prior(u))]])
    return Fit(
        u=u,
        weight=np.full(len(u), 1 / len(u)),
        log_likelihood=np.append(log_likelihood[0], np.full(len(u) - 1, -np.inf)),
        log_evidence=log_z,
        standard_error=0.0,
        effective_sample_size=float(len(u)),
        tail_shape=np.nan,
        method="laplace",
        is_rough=False,
        free=none,
        found=found,
        particles=None,
        pool=Pool.empty(dim, potential.num_trials),
    )


def _of_particles(
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
        tail_shape=np.nan,
        method="smc",
        is_rough=False,
        free=free,
        found=found,
        particles=moved,
        pool=_as_pool(moved, potential, settings, rng),
    )


def _begin(
    pool: Pool,
    potential: Potential,
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
        first = _around(found, potential, settings)
        pool.add(first, first.sample(settings.num_draws, rng), potential)
        effective = pool.effective_sample_size
        if effective >= settings.fewest or settings.affords(
            effective, pool.num_final, settings.num_effective
        ):
            return
    if near is not None and len(near) > 2 * potential.dim:
        own = fitted(near, np.full(len(near), 1 / len(near)), 2, settings, rng)
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


def _around(
    found: Found, potential: Potential, settings: Settings
) -> SplitStudentMixture:
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
    fall = np.maximum(peak - log_p, 1e-2)
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
    return SplitStudentMixture(guess.means, axes, left, right, guess.weights, freedom)


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


def _particles(
    potential: Potential,
    found: Found,
    free: NDArray[np.bool_],
    rng: np.random.Generator,
    settings: Settings,
) -> Bridged | None:
    """Return particles of all parameters; only those that trials inform are moved."""
    guess, axes = found.guess, np.flatnonzero(~free)
    cov = guess.factors @ np.swapaxes(guess.factors, 1, 2)
    factors = np.linalg.cholesky(cov[:, axes[:, None], axes])
    # Tails that bend away from the normal of a mode are out of its own reach.
    own = NormalMixture(
        np.concatenate([guess.weights * weight for _, weight in WIDTHS]),
        np.concatenate([guess.means[:, axes]] * len(WIDTHS)),
        np.concatenate([factors * width for width, _ in WIDTHS]),
    )
    rest = np.zeros((1, potential.dim))

    def whole(u: Array) -> Array:
        full = np.repeat(rest, len(u), 0)
        full[:, axes] = u
        return full

    fixed = _log_free(potential, free, rng) if free.any() else 0.0
    num = int(settings.per_parameter * len(axes) * settings.num_effective)
    moved = bridge(
        lambda u: potential.log_prior(whole(u)) - fixed,
        lambda u: potential.log_likelihood(whole(u)),
        own,
        rng,
        num_particles=max(num, settings.fewest_particles),
        most=settings.budget(len(axes)) / potential.num_trials,
    )
    if moved is None:
        return None
    u = moved.u
    if free.any():
        u = potential.sample_prior(len(moved.u), rng)
        u[:, axes] = moved.u
    rows = np.isfinite(potential.log_prior(u))
    return replace(moved, u=u[rows], log_likelihood=moved.log_likelihood[rows])


def _free(
    found: Found, potential: Potential, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Return parameters that change no trial and do not depend on others."""
    free = ~found.informed
    none = np.zeros(potential.dim, dtype=bool)
    if not free.any() or free.all():
        return none
    drawn, other = (potential.sample_prior(NUM_PROBES, rng) for _ in range(2))
    c = potential.coordinates
    near, off = (
        np.clip(found.guess.sample(NUM_PROBES, rng), c.low, c.high) for _ in range(2)
    )

    def changes(axes: NDArray[np.bool_]) -> bool:
        pairs = (drawn, np.where(axes, other, drawn)), (near, np.where(axes, off, near))
        residuals = (
            np.abs(potential.residual(a)[0] - potential.residual(b)[0])
            for a, b in pairs
        )
        return any(r.max() > UNCHANGED for r in residuals)

    for axis in np.flatnonzero(free):
        free[axis] = not changes(np.arange(potential.dim) == axis)
    is_free = free.any() and potential.splits_off(free, rng) and not changes(free)
    return free if is_free else none


def _log_free(
    potential: Potential, free: NDArray[np.bool_], rng: np.random.Generator
) -> float:
    r"""Return the prior's log density of the free coordinates at zero.

    Independent of the others, which stay at zero, it is

    .. math::
        p_F(0) = p(0) \Big/ \int p(0, u_F)\, du_F .
    """
    u = np.zeros((NUM_INTEGRAL, potential.dim))
    u[:, free] = WIDER * rng.standard_normal((len(u), int(free.sum())))
    square = ((u[:, free] / WIDER) ** 2 + np.log(2 * np.pi * WIDER**2)).sum(1)
    log_w = potential.log_prior(u) + 0.5 * square
    integral = log_sum_exp(log_w) - np.log(len(u))
    return float(potential.log_prior(u[:1] * 0)[0] - integral)
