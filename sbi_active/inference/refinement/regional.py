"""Polynomials in regions around what is plausible, on all trials of a history."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from sbi_active.arrays import Array
from sbi_active.inference.declared.contradiction import Contradiction, compared
from sbi_active.inference.declared.diagnosing import Doubt
from sbi_active.inference.declared.refining import Problem
from sbi_active.inference.engine.learned import LearnedBelief
from sbi_active.inference.refinement.checks import (
    Fresh,
    compared_with_fresh,
    expected_error,
    noise_tails,
    outcomes_at,
    widened,
)
from sbi_active.inference.refinement.stages import Stage, Stages, StageSettings
from sbi_active.inference.regression.histories import Histories, HistoryRecord
from sbi_active.inference.regression.regions import around, cover, whole_space
from sbi_active.inference.regression.surrogate import Surrogate, fewest_rows, is_misfit
from sbi_active.inference.rounds.rows import UnexplainedOutcomeError, warn_missing
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.seeding import derive_seed


class Regions(Stages):
    """Histories in regions, and a polynomial in each.

    Args:
        problem: The posterior that is asked for.
        past: Histories of the first of its trials.
        further_noise: Standard deviations of noise to add, shape (t, q).

    Attributes:
        fresh: What fresh simulations say of the last stage.
    """

    fresh: Fresh

    def __init__(
        self,
        problem: Problem,
        *,
        past: HistoryRecord | None = None,
        further_noise: Array | None = None,
    ) -> None:
        prior, settings, seed = problem.prior, problem.settings, problem.seed
        rng = np.random.default_rng(derive_seed(seed, "refine"))
        coordinates = PriorCoordinates(prior, rng)
        own, budget = StageSettings(), settings.num_histories
        super().__init__(prior, settings, own, budget, rng, coordinates)
        self.action, self.outcome = problem.action, problem.x
        self.histories = Histories(
            *(problem.simulator, self.action, self.outcome.flatten(1).numpy()),
            *(coordinates, seed, past, settings.workers),
            further_noise=further_noise,
        )
        near = coordinates.drawn_from(problem.hints, 1_000, seed=seed)
        self.regions = [whole_space(coordinates.dim), *map(around, near)]
        self.near = np.concatenate(near) if near else None
        self.shape_change = 0.0
        self.least = max(own.fewest, 2 * fewest_rows(coordinates.dim))

    def spent(self) -> tuple[int, int]:
        """Return the histories simulated or taken over, and the rows."""
        return self.histories.num_drawn, self.histories.num_simulations

    def run(self) -> LearnedBelief:
        """Return the belief with its histories, and what they say of lost outcomes."""
        belief, histories, stage = super().run(), self.histories, self.stages[-1]
        belief.diagnostics = belief.diagnostics.extended(
            error_nats_if_explained=expected_error(
                stage.surrogate, stage.draws, self.rng, explained=True
            ),
            share_invalid=histories.share_invalid,
            probability_of_outcome=self.probability_of_outcome,
            num_missing=histories.num_missing,
        )
        belief.histories = histories.record()
        spent, lost = histories.num_simulations, histories.num_missing
        warn_missing(lost, spent, "the histories they belong to")
        return belief

    def _propose(self, stage: Stage, size: int) -> None:
        """Put the next stage's regions around what is still plausible."""
        limit = max(1, int(size / (1.2 * fewest_rows(self.coordinates.dim))))
        self.regions = cover(
            stage.draws,
            self.rng,
            max_regions=min(self.own.max_regions, limit),
            generous=stage.excess < 3,
            wide=not is_misfit(stage.excess),
        )

    def simulate(self, size: int) -> None:
        """Bring the stage's regions to their numbers, past histories first."""
        if self.stages:
            self._propose(self.stages[-1], size)
        histories, regions, own = self.histories, self.regions, self.own
        is_first, num = histories.num_drawn == 0, len(regions)
        weights = np.ones(num)
        if is_first and num > 2:  # the overview keeps half of the stage
            weights[0] = num - 1
        ends = np.round(size * weights.cumsum() / weights.sum(), 6).astype(int)
        for k, count in enumerate(np.diff(ends, prepend=0)):
            # The first stage's first region is the whole space, seen from the prior.
            is_overview = is_first and k == 0
            share = max(own.replicate_share, 12 / size)
            count -= histories.reuse(regions[k], int(count), is_overview=is_overview)
            if count <= 0:
                continue
            num_repeated = int(share * count)
            missing = int(count) - num_repeated
            z = regions[k].sample_inside(missing, self.coordinates, self.rng)
            if len(z) == 0:  # it lies beside the support, as of an outcome far away
                z = self.coordinates.sample_prior(missing, self.rng)
            z = self.rng.permutation(z)
            histories.add(z, min(num_repeated, len(z)), is_overview=is_overview)

    def fit(self, near: Array | None, *, is_last: bool) -> Surrogate:
        """Return the regressions of the regions that have simulations enough."""
        histories = self.histories
        fits = [histories.regress(region) for region in self.regions]
        regressions = [fit for fit in fits if fit is not None]
        if regressions:
            return Surrogate(self.coordinates, regressions, is_cautious=not is_last)
        num_valid, num = int(histories.valid.sum()), histories.num_drawn
        if 2 * num_valid > len(histories.valid):  # it is not the outcomes that lack
            raise ValueError(
                f"expected at least {self.least} histories for "
                f"{self.coordinates.dim} parameters; got {num}; raise num_histories"
            )
        raise UnexplainedOutcomeError(
            "expected simulations with a measurement, since trials had one; got none "
            f"or NaN in {num - num_valid} of {num} histories; check the simulator at "
            "the executed actions, or the prior"
        )

    def judged(self, surrogate: Surrogate, draws: Array) -> tuple[float, Array, float]:
        """Return the worst misfit, the mass of each region and the expected error."""
        label, fits = surrogate.assign(draws), surrogate.regressions
        mass = np.bincount(label[label >= 0], minlength=len(fits))
        mass = mass / max(mass.sum(), 1)
        live = [f.excess for f, m in zip(fits, mass, strict=True) if m > self.own.live]
        error = expected_error(surrogate, draws, self.rng)
        return max(live, default=np.inf), mass, error

    def with_more(self, stage: Stage) -> Stage:
        """Return the stage with simulations from further off that agree."""
        wider, bias = widened(
            self.histories, stage.surrogate, stage.error, stage.draws, self.rng
        )
        if wider is stage.surrogate:
            return stage
        wide = self.sample(wider, stage.draws)
        return replace(wide, error=wide.error + bias)

    def last(self, stage: Stage) -> Stage:
        """Return the stage with noise that is not Gaussian, where it is not."""
        own, c = self.own.shapes, self.coordinates
        fits = [
            self.histories.regress(f.region, own) for f in stage.surrogate.regressions
        ]
        shaped = [fit for fit in fits if fit is not None]
        if all(fit.shape is None for fit in shaped):
            return stage
        other = self.sample(Surrogate(c, shaped), stage.draws)
        self.shape_change = other.after(stage).change
        error = max(stage.error, other.error)
        return replace(
            other, error=error, change=stage.change, shrinkage=stage.shrinkage
        )

    def tails(self, stage: Stage) -> list[float]:
        """Return tail probabilities, by fresh simulations at draws of the belief."""
        c, own = self.coordinates, self.own
        num = max(own.least_checked, int(own.checked_share * self.budget))
        theta = c.to_theta(stage.fit.draws(num, self.rng))
        x, lost = self.histories.fresh(theta)
        z, num_trials = c.to_z(theta), len(self.action)
        self.fresh = compared_with_fresh(
            stage.surrogate, z[~lost], x[~lost], num_trials, own
        )
        return self.fresh.tails

    def doubts(self) -> tuple[dict[str, Doubt], dict[str, Any]]:
        """Return what the regressions take for granted, and the trials that are odd."""
        last, fresh, own = self.stages[-1], self.fresh, self.own
        fits, dim = last.surrogate.regressions, self.coordinates.dim
        pairs = zip(fits, last.mass, strict=True)
        ratio = max((f.ratio for f, mass in pairs if mass > own.live), default=np.inf)
        roughness = self.stages[0].surrogate.regressions[0].roughness
        tails, has_edges = noise_tails(self.stages, own)
        known = 0.0
        if any(fit.shape is not None for fit in fits):
            # Of d parameters known to e nats, a mean is off by (2 e / d)^(1/2)
            # deviations.
            allowed = 0.5 * dim * own.known**2
            known = self.shape_change / (own.unsettled * dim)
            known = max(last.error / allowed, known)
        share, blur = outcomes_at(last.surrogate, last.draws, self.histories, own)
        self.probability_of_outcome = share
        rare = ", ".join(str(k) for k, p in enumerate(share) if p < own.rare)
        depends = fresh.correlation >= own.correlated and not is_misfit(last.excess)
        doubts: dict[str, Doubt] = {
            "confirmed": (fresh.shift <= fresh.limit, fresh.shift),
            "gaussian_noise": (not has_edges, tails),
            "noise_known": (known <= 1, known),
            "smooth_response": (roughness <= own.rough, roughness),
            "no_misfit": (last.excess <= own.misfit, ratio),
            "independent_trials": (not depends, fresh.correlation),
            "outcomes_followed": (blur <= own.blurred, blur),
            "outcomes_usual": (not rare, min(share)),
        }
        return doubts, {"rare": rare}

    def contradiction(self) -> Contradiction | None:
        """Return what contradicts at the draw that the last stage explains best."""
        sds = torch.from_numpy(self.histories.noise_sds).mean(0)
        sds = torch.where(sds > 0, sds, torch.inf)
        return compared(
            self.action,
            self.outcome,
            lambda gap: gap.flatten(1) / sds,
            self.fresh.least,
            num_fitted=self.coordinates.dim,
        )
