"""The posterior of a potential, in one way: search, importance sampling, SMC.

1. Gauss-Newton searches find the modes and their widths.
2. Importance sampling from a mixture around these and the prior, which is fitted to the
   draws again and again; where too few count, the likelihood is tempered.
3. Where enough draws are effective, that is the posterior; another proposal is fitted
   while few of them outweigh all others. Otherwise particles are led from the modes to
   it by sequential Monte Carlo, whose cost grows little with the number of parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.inference.engine.bounded import LinearResponse, LineMoves, led_between
from sbi_active.inference.engine.importance import (
    ImportanceSampling,
    fitted,
    pareto_shape,
)
from sbi_active.inference.engine.pool import Fit, Pool, PriorDraws
from sbi_active.inference.engine.potential import Density, Potential
from sbi_active.inference.engine.search import Found
from sbi_active.inference.engine.settings import Settings
from sbi_active.inference.sampling.mixtures import (
    StudentMixture,
    wider,
)
from sbi_active.inference.sampling.smc import Bridged, bridge
from sbi_active.inference.sampling.weights import log_sum_exp, normalized


def infer(
    potential: Density,
    rng: np.random.Generator,
    *,
    found: Found | None = None,
    near: Array | None = None,
    settings: Settings = Settings(),  # noqa: B008  (frozen)
) -> Fit:
    """Return the posterior of a potential.

    Args:
        potential: Log density of the parameters given all trials, with residuals where
            modes of it were found.
        rng: Source of the draws.
        found: Modes of the potential; None if a search got nowhere.
        near: Draws of a guess, shape (n, d), looked at where the modes do not suffice.
        settings: Numbers of draws, and what decides between the ways.
    """
    modes = None
    if found is not None:  # what was searched has residuals
        modes = _Modes(found, cast(Potential, potential), rng, settings)
    none = np.zeros(potential.dim, dtype=bool)
    if modes is not None:
        free = modes.uninformed()
        if free.any() or share_cut(modes.potential, modes.found) > settings.hopeless:
            moved = modes.led_particles(free)
            if moved is not None:
                return modes.fit_of(moved, free)
    pool = Pool.empty(potential.dim)
    _begin(pool, potential, rng, modes, near, settings)
    num_modes = 0 if found is None else len(found.modes)
    sampling = ImportanceSampling(
        *(pool, potential, rng, max(settings.num_components, num_modes), settings),
        found=found,
    )
    sampling.run()
    final, effective = pool.is_final, pool.effective_sample_size
    # Particles are led where normal draws would have to be more.
    wanted = settings.asked(1.0, (potential.dim + 3) / 4, is_cheap=False)
    if modes is not None and effective < wanted:
        moved = modes.led_particles(none)
        if moved is not None and moved.effective_sample_size > effective:
            return modes.fit_of(moved, none)
    shape = np.inf  # as where draws of another proposal outweigh these
    if final.any() and pool.missed <= settings.most_missed:
        shape = pareto_shape(pool.log_weight[final])
    return Fit(
        u=pool.u[final],
        weight=normalized(pool.log_weight[final]) if final.any() else np.zeros(0),
        log_likelihood=pool.log_likelihood[final],
        log_evidence=pool.log_evidence,
        standard_error=pool.standard_error,
        effective_sample_size=effective,
        tail_shape=shape,
        method="importance",
        is_rough=sampling.is_rough,
        free=none,
        found=found,
        final=pool.final,
        num_drawn=pool.num_final,
        num_stages=len(pool.proposals),
    )


def _begin(
    pool: Pool,
    potential: Density,
    rng: np.random.Generator,
    modes: _Modes | None,
    near: Array | None,
    settings: Settings,
) -> None:
    """Add draws of the prior and around the modes; more where these do not count."""
    prior, own = PriorDraws(potential), settings
    if modes is not None:
        pool.add(prior, modes.found.screened, potential)  # simulated for the search
        pool.restart()
        first = modes.around()
        pool.add(first, first.sample(own.num_draws, rng), potential)
        effective = pool.effective_sample_size
        missing = (own.num_effective - effective) * pool.num_final / (effective + 1e-9)
        is_known = effective >= own.seen
        if effective >= own.fewest or (
            is_known and own.affords(missing, potential.dim)
        ):
            return
    if near is not None and len(near) > 2 * potential.dim:
        weight = np.full(len(near), 1 / len(near))
        guess = fitted(near, weight, own.num_components, own, rng)
        drawn = guess.sample(own.num_draws, rng)
        pool.add(guess, drawn, potential, is_final=modes is None)
    drawn = prior.sample(int(1.5 * own.num_draws), rng)
    pool.add(prior, drawn, potential, is_final=modes is None)


def share_cut(potential: Potential, found: Found, *, num: int = 500) -> float:
    """Return the share of the modes' normal approximations beyond the bounds."""
    c, rng = potential.coordinates, np.random.default_rng(0)
    drawn = found.guess.sample(num, rng)
    return float(((drawn < c.low) | (drawn > c.high)).any(1).mean())


@dataclass(frozen=True)
class _Modes:
    """The modes that a search found, and what draws begin from them.

    Attributes:
        found: The modes.
        potential: The potential.
        rng: Source of the draws.
        settings: Settings of :func:`infer`.
    """

    found: Found
    potential: Potential
    rng: np.random.Generator
    settings: Settings

    def around(self) -> StudentMixture:
        r"""Return a mixture around the modes, as wide on each side as the density is.

        Along each axis of a mode's normal approximation, of unit length there, within
        bounds,

        .. math::
            s = \max_t \frac{t}{\sqrt{2 (\log p(m) - \log p(m + t a))}},

        which is 1 of a normal density, and more towards a shelf.
        """
        found, potential, own = self.found, self.potential, self.settings
        c, guess = potential.coordinates, found.guess
        k, d = found.modes.shape
        cov = guess.factors @ np.swapaxes(guess.factors, 1, 2) / found.wider**2
        values, vectors = np.linalg.eigh(cov)
        axes = vectors * np.sqrt(np.maximum(values, 1e-24))[:, None]
        length = np.abs(axes).max(1)  # (k, d), in deviations of the prior
        far = np.multiply.outer(own.profiled, 1 / np.maximum(length[:k], 1e-12))
        near = np.multiply.outer(own.profiled_near, np.ones((k, d)))
        steps = np.sort(np.concatenate([near, far]), axis=0)
        sides = np.stack([-steps, steps])  # (2, s, k, d)
        places = found.modes[:, None] + np.swapaxes(axes[:k], 1, 2) * sides[..., None]
        at = np.concatenate([found.modes, places.reshape(-1, d)])
        is_inside = np.all((at >= c.low) & (at <= c.high), axis=1)
        at = np.clip(at, c.low, c.high)
        log_p = potential.log_prior(at) + potential.log_likelihood(at)
        peak, log_p = log_p[:k, None], log_p[k:].reshape(sides.shape)
        # Residuals, which modes are of, say nothing of trials without an outcome, so
        # that a mode itself may be impossible: what is as impossible is no part of it.
        fall = np.full(sides.shape, np.inf)
        np.subtract(peak, log_p, out=fall, where=np.isfinite(log_p))
        fall = np.maximum(fall, 1e-2)
        # Beyond a valley there are other modes.
        within = np.maximum.accumulate(fall, axis=1) < own.valley
        within &= is_inside[k:].reshape(sides.shape)
        within = np.concatenate([np.ones_like(within[:, :1]), within[:, 1:]], 1)
        width = np.where(within, np.abs(sides) / np.sqrt(2 * fall), 0.0).max(1)
        widest = np.maximum(1 / np.maximum(length[:k], 1e-12), 1.0)
        others = np.ones((2, len(axes) - k, d))  # of another error, are no modes
        width = np.concatenate([np.clip(width, 1.0, widest), others], 1)
        left, right = wider(own.laplace_wider, d) * width
        freedom = max(own.freedom, float(d))
        return StudentMixture(guess.means, axes, guess.weights, freedom, left, right)

    def uninformed(
        self, *, unchanged: float = 2e-3, num: int = 16
    ) -> NDArray[np.bool_]:
        """Return parameters that change no trial and do not depend on others.

        Single precision may change a residual by ``unchanged`` deviations of the noise.
        """
        found, potential, rng = self.found, self.potential, self.rng
        free = ~found.informed
        none = np.zeros(potential.dim, dtype=bool)
        if not free.any() or free.all():
            return none
        c = potential.coordinates
        drawn, other = (potential.sample_prior(num, rng) for _ in range(2))
        near, off = (
            np.clip(found.guess.sample(num, rng), c.low, c.high) for _ in range(2)
        )

        def changes(axes: NDArray[np.bool_]) -> bool:
            for u, moved in ((drawn, other), (near, off)):
                before = potential.residual(u)[0]
                after = potential.residual(np.where(axes, moved, u))[0]
                if np.abs(before - after).max() > unchanged:
                    return True
            return False

        for axis in np.flatnonzero(free):
            free[axis] = not changes(np.arange(potential.dim) == axis)
        is_free = free.any() and potential.splits_off(free, rng) and not changes(free)
        return free if is_free else none

    def led_particles(
        self,
        free: NDArray[np.bool_],
        *,
        widths: tuple[tuple[float, float], ...] = ((1.0, 0.4), (2.0, 0.3), (3.0, 0.3)),
    ) -> Bridged | None:
        """Return particles of all parameters; those that trials inform are moved."""
        potential, rng, own = self.potential, self.rng, self.settings
        guess, axes = self.found.guess, np.flatnonzero(~free)
        cov = guess.factors @ np.swapaxes(guess.factors, 1, 2)
        factors = np.linalg.cholesky(cov[:, axes[:, None], axes])
        # Tails that bend away from the normal of a mode are out of its own reach.
        start = StudentMixture(
            np.concatenate([guess.means[:, axes]] * len(widths)),
            np.concatenate([factors * width for width, _ in widths]),
            np.concatenate([guess.weights * weight for _, weight in widths]),
            np.inf,
        )
        fixed = self._log_free(free) if free.any() else 0.0
        num = int(own.per_parameter * len(axes) * own.num_effective)
        most = own.budget(len(axes)) / potential.num_trials
        few = max(int(min(num, most / own.passes)), own.fewest_particles)

        def whole(u: Array) -> Array:
            full = np.zeros((len(u), potential.dim))
            full[:, axes] = u
            return full

        def log_prior(u: Array) -> Array:
            return potential.log_prior(whole(u)) - fixed

        def log_likelihood(u: Array) -> Array:
            return potential.log_likelihood(whole(u))

        low, high = potential.coordinates.low[axes], potential.coordinates.high[axes]
        drawn = start.sample(few, rng)
        densities, moved = (log_prior, log_likelihood), None
        if ((drawn < low) | (drawn > high)).any(1).mean() < own.most_cut:
            moved = bridge(*densities, start, rng, num_particles=few, most=most)
            if moved is not None:  # as many moves of more particles
                most -= moved.num_evaluations
                more = int(min(num, few * most / moved.num_evaluations))
                if more > few:
                    again = bridge(
                        *densities, start, rng, num_particles=more, most=most
                    )
                    moved = again or moved
        else:
            response = LinearResponse(potential, self.found, axes)
            precision = potential.coordinates.precision[axes]
            # Far from what is linear the rows may suffice for fewer.
            for size in dict.fromkeys((few, max(few // 4, own.fewest_particles))):
                moves = LineMoves(response, low, high, precision)
                prior = np.clip(potential.sample_prior(size, rng)[:, axes], low, high)
                moved = led_between(*densities, response, moves, prior, rng, most=most)
                if moved is not None:
                    break
        if moved is None:
            return None
        u = moved.u
        if free.any():
            u = potential.sample_prior(len(moved.u), rng)
            u[:, axes] = moved.u
        rows = np.isfinite(potential.log_prior(u))
        return replace(moved, u=u[rows], log_likelihood=moved.log_likelihood[rows])

    def _log_free(
        self, free: NDArray[np.bool_], *, num: int = 4_000, wider: float = 1.1
    ) -> float:
        r"""Return the prior's log density of the free coordinates at zero.

        Independent of the others, which stay at zero, it is

        .. math::
            p_F(0) = p(0) \Big/ \int p(0, u_F)\, du_F ,

        by draws from a normal density a little wider than the prior.
        """
        u, log_prior = np.zeros((num, self.potential.dim)), self.potential.log_prior
        u[:, free] = wider * self.rng.standard_normal((num, int(free.sum())))
        square = ((u[:, free] / wider) ** 2 + np.log(2 * np.pi * wider**2)).sum(1)
        integral = log_sum_exp(log_prior(u) + 0.5 * square) - np.log(num)
        return float(log_prior(u[:1] * 0)[0] - integral)

    def fit_of(self, moved: Bridged, free: NDArray[np.bool_]) -> Fit:
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
            found=self.found,
            particles=moved,
            num_drawn=n,
        )
