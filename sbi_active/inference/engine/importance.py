r"""Importance sampling from mixtures that are fitted to all draws so far.

Each draw is weighted under the mixture of all proposals,

.. math::
    w_i = \frac{p(u_i)\, L(u_i)}{\sum_k n_k\, q_k(u_i) / n} .

Where few draws count, the next proposal is fitted to

.. math::
    p(u)\, L(u)^\beta

with the largest :math:`\beta` that leaves enough of them, up to 1: of a response that
jumps, the draws of the prior are led to the posterior so.

A parameter that another can stand in for leaves a curved ridge, on which a normal
approximation at a mode has few of its draws, and a few components fitted to draws have
not many more: there narrow proposals lie along the ridge (:mod:`.ridges`).

Of more than a few parameters, most draws of a mixture count for little. Once enough do,
a surface of the likelihood says which of further ones to simulate (:mod:`.surface`).

References:
    Cornuet, Marin, Mira & Robert, Scand. J. Stat. 2012 (adaptive multiple importance
    sampling); Veach & Guibas, SIGGRAPH 1995 (the balance heuristic).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np
from scipy.special import entr

from sbi_active.arrays import Array
from sbi_active.inference.engine.pool import Pool
from sbi_active.inference.engine.potential import Density, Potential
from sbi_active.inference.engine.ridges import Ridge, along_ridges
from sbi_active.inference.engine.search import Found
from sbi_active.inference.engine.settings import CHEAP, Settings
from sbi_active.inference.engine.surface import (
    Screened,
    SurfacePotential,
    fitted_surface,
)
from sbi_active.inference.sampling.mixtures import (
    Defended,
    Proposal,
    StudentMixture,
    fitted_normals,
    wider,
)
from sbi_active.inference.sampling.weights import (
    effective_sample_size,
    largest_power,
    normalized,
    systematic,
)


@dataclass
class ImportanceSampling:
    """Adds draws to a pool, of proposals that are fitted to it, until enough count.

    The posterior rests on the draws of one proposal, which was fitted to none of them:
    its evidence has no bias.

    Args:
        pool: Draws to begin with.
        potential: Potential of all trials.
        rng: Source of the draws.
        num_components: Number of components of a proposal at most.
        settings: Numbers of draws.
        found: Modes, whose potential has residuals; None if there are none.

    Attributes:
        num_full: Number of proposals fitted to the whole likelihood.
        num_tempered: Number of those to a power of it.
        ridge: Places along ridges, of the last proposal there.
        is_along: Whether the last proposal was along ridges; None before any.
        best: Largest share of a proposal's draws that were effective, by enough draws.
        efficiency: Share of the draws that were effective of the last proposal along
            ridges, and of the last other one.
    """

    pool: Pool
    potential: Density
    rng: np.random.Generator
    num_components: int
    settings: Settings
    found: Found | None = None
    num_full: int = 0
    num_tempered: int = 0
    ridge: Ridge | None = None
    is_along: bool | None = None
    best: float = 0.0
    efficiency: dict[bool, float] = field(default_factory=dict)

    @property
    def is_rough(self) -> bool:
        """Whether the likelihood had to be tempered often."""
        return self.num_tempered > self.settings.few_tempered

    @property
    def num_modes(self) -> float:
        """The number of modes, by the entropy of their weights; 1 along a ridge."""
        if self.found is None or self.ridge is not None:
            return 1.0
        return float(np.exp(entr(self.found.guess.weights).sum()))

    def run(self) -> None:
        """Draw until enough are effective, or the budget is spent."""
        pool, potential, own = self.pool, self.potential, self.settings
        budget, start = own.budget(potential.dim), potential.num_simulations
        proposal, heavy, least = pool.final, 0, 0.0
        for _ in range(own.max_rounds):
            left = budget - (potential.num_simulations - start)
            power = self._largest_power(own.fewest)
            effective = pool.effective_sample_size
            is_cheap = left > (1 - own.share_of_plenty) * budget and not self.is_rough
            divergence = self.num_modes * pool.divergence
            wanted = own.asked(effective, divergence, is_cheap=is_cheap)
            wanted = max(wanted, least)
            if not len(pool.u) or left <= 0:
                return
            is_heavy = False
            if power == 1 and effective >= wanted:
                shape = pareto_shape(pool.log_weight[pool.is_final])
                is_heavy = shape > own.largest_shape
                if not is_heavy or heavy == own.max_heavy:
                    return
                heavy += 1  # draws that outweigh others show where to draw more
                least = effective
            efficiency = max(effective, 1e-9) / max(pool.num_final, 1)
            is_known = proposal is not None and effective >= own.seen
            missing = (wanted - effective) / efficiency  # draws
            is_good = power == 1 and efficiency >= own.efficient
            is_good |= is_known and own.affords(missing, potential.dim)
            # It no longer gets better by being fitted again.
            is_last = self.num_full >= own.max_fits
            is_good |= is_last and efficiency >= 0.5 * self.best > 0
            size = own.draws_of_fit(potential.dim)
            if proposal is not None and is_good and not is_heavy:
                least_size, most_size = 0.2 * own.num_draws, 4 * own.num_draws
                size = int(np.clip(1.1 * missing, least_size, most_size))
            else:
                if effective >= own.seen:
                    self.best = max(self.best, efficiency)
                pool.restart()
                proposal = self._fitted(power, efficiency)
            best = float((pool.log_prior + pool.log_likelihood).max())
            floor = best - own.negligible / power
            pool.add(proposal, proposal.sample(size, self.rng), potential, floor)

    def _fitted(self, power: float, efficiency: float) -> Proposal:
        """Return a proposal for a power of the likelihood, fitted to all draws.

        A mixture that is dense around the draws alone misses tails, and the peaks of a
        rough likelihood between those that were found: it has a share of a wider one.

        Args:
            power: Power of the likelihood.
            efficiency: Share of the last proposal's draws that were effective.
        """
        pool, own, rng = self.pool, self.settings, self.rng
        # Few draws may lie across a ridge, of which a surface sees a piece.
        sees_all = power == 1 or self.ridge is not None
        screened = self._screened(efficiency) if sees_all else None
        if screened is not None:
            self.num_full += 1
            return screened
        share = own.share_if_rough if self.is_rough else own.share_of_wide
        self.num_full += power == 1
        self.num_tempered += power < 1
        main, wide = self._tempered(power, self.num_components), self._wide()
        if self.is_along is not None:
            self.efficiency[self.is_along] = efficiency
        self.is_along = False
        # Where few draws count, they may lie across a ridge.
        is_early = self.num_full + self.num_tempered <= own.num_ridged
        known = self.efficiency
        is_better = known.get(True, 0.0) > known.get(False, np.inf)
        if self.found is not None and (is_early or is_better):
            full = normalized(pool.log_mixture_weight)
            if self.ridge is not None:
                self.ridge = self.ridge.grown(pool.u, full, rng)
            elif power < 1:
                some = pool.u[np.unique(systematic(full, own.num_ridge, 0.5))]
                # What was searched has residuals.
                searched = cast(Potential, self.potential)
                self.ridge = along_ridges(searched, self.found, some, rng, own)
            if self.ridge is not None:
                self.is_along = True
                return self.ridge.mixture
        return Defended(main, wide, share)

    def _screened(self, efficiency: float) -> Proposal | None:
        """Return draws that a surface of the likelihood lets pass; None if it is bad.

        Args:
            efficiency: Share of the last proposal's draws that were effective.
        """
        # Of few parameters a mixture follows the posterior.
        if self.found is None or self.potential.dim <= self.settings.few:
            return None
        own, rng = self.settings.surface, self.rng
        searched = cast(Potential, self.potential)  # what was searched has residuals
        whiten = searched.whitener(self.found.modes[:1])
        surface = fitted_surface(searched, whiten, self.pool, rng, own)
        least = max(own.good, efficiency)
        if surface is None or surface.efficiency < least:
            return None
        target = SurfacePotential(self.potential, surface)
        pool = target.reweighted(self.pool)
        free = replace(CHEAP, num_effective=own.num_effective, fitted=1.0)
        num = max(own.num_components, self.num_components)
        ImportanceSampling(pool, target, rng, num, free).run()
        if pool.final is None:
            return None
        base = Defended(pool.final, self._wide(), self.settings.share_of_wide)
        screened = Screened(base, target).leveled(rng, own)
        return screened if screened.efficiency >= least else None

    def _wide(self) -> Proposal:
        """Return a proposal fitted to a power of the likelihood that leaves many."""
        return self._tempered(self._largest_power(self.settings.broad), 2)

    def _tempered(self, power: float, num_components: int) -> Proposal:
        """Return a proposal fitted to all draws by a power of the likelihood."""
        pool = self.pool
        weight = normalized(
            pool.log_prior - pool.log_mixture + power * pool.log_likelihood
        )
        return fitted(pool.u, weight, num_components, self.settings, self.rng)

    def _largest_power(
        self, needed: float, *, shrinks: float = 0.8, least: float = 1e-10
    ) -> float:
        """Return the largest power of the likelihood that leaves enough draws.

        Downward from 1: where most draws are near the posterior, a few of the prior
        outweigh them at lower powers, and fewer are effective there. Each power that is
        tried is so much less than the last, down to the least.
        """
        log_rest = self.pool.log_prior - self.pool.log_mixture
        needed = min(needed, 0.5 * effective_sample_size(log_rest))

        def suffices(power: float) -> bool:
            log_weight = log_rest + power * self.pool.log_likelihood
            return effective_sample_size(log_weight) >= needed

        high = 1.0
        while high > least and not suffices(high):
            high *= shrinks
        if high == 1 or high <= least:
            return max(high, least)
        return largest_power(suffices, start=high, end=min(high / shrinks, 1.0))


def fitted(
    u: Array,
    weight: Array,
    num_components: int,
    settings: Settings,
    rng: np.random.Generator,
) -> StudentMixture:
    """Return a mixture fitted to weighted draws, wider than these.

    Args:
        u: Draws, shape (n, d).
        weight: Weights of the draws, which sum to 1, shape (n,).
        num_components: Number of components at most; fewer where few draws count.
        settings: Settings that say how much wider it is.
        rng: Source of its starts.
    """
    dim = u.shape[1]
    num = settings.num_fitted(dim)
    effective = 1 / float((weight**2).sum())
    # A mean and a covariance have d (d + 3) / 2 numbers.
    num_components = int(np.clip(4 * effective / (dim * (dim + 3)), 1, num_components))
    some = u[systematic(weight, num, rng.random())]
    some = some + settings.jitter * some.std(0) * rng.standard_normal(some.shape)
    fit = fitted_normals(some, num_components, rng)
    return replace(
        fit,
        factors=wider(settings.wider, dim) * fit.factors,
        freedom=max(settings.freedom, float(dim)),
    )


def pareto_shape(log_weight: Array) -> float:
    r"""Return the shape k of the tail of weights, of which moments below 1/k exist.

    The excess x over a threshold is taken for generalized Pareto, and k is estimated as
    by Zhang and Stephens: it is the mean of :math:`\log(1 - b x)` with b averaged over
    its likelihood, and is drawn to .5 as by ten further numbers.

    Args:
        log_weight: Log weights, shape (n,).

    References:
        Zhang & Stephens, Technometrics 51 (2009); Vehtari, Simpson, Gelman, Yao &
        Gabry, JMLR 25 (2024).
    """
    weight = np.sort(normalized(log_weight))
    num = int(np.ceil(min(0.2 * len(weight), 3 * len(weight) ** 0.5)))
    if num < 5 or num == len(weight) or weight[-1] <= 0:
        return np.inf
    x = weight[-num:] - weight[-num - 1]
    if x[-1] <= 1e-12 * weight[-1]:
        return -np.inf  # all alike
    x = np.maximum(x / x.mean(), 1e-12)
    size = 30 + int(num**0.5)
    grid = 1 - (size / (np.arange(1, size + 1) - 0.5)) ** 0.5
    b = 1 / x[-1] + grid / (3 * x[int(num / 4 + 0.5) - 1])
    k = np.log1p(-b[:, None] * x).mean(1)
    log_likelihood = num * (np.log(-b / k) - k - 1)
    b_mean = float(normalized(log_likelihood) @ b)
    shape = float(np.log1p(-b_mean * x).mean())
    return (num * shape + 10 * 0.5) / (num + 10)
