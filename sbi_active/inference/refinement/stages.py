"""Stages of a refinement: propose, simulate, regress, sample, judge."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.declared.contradiction import (
    Contradiction,
    compared,
)
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.engine.learned import LearnedPotential, learned_fit
from sbi_active.inference.refinement.learned_belief import LearnedBelief
from sbi_active.inference.refinement.outcome_checks import check_outcomes
from sbi_active.inference.refinement.regression_error import widened
from sbi_active.inference.refinement.settings import StageSettings
from sbi_active.inference.refinement.trust import (
    Course,
    Stage,
    diagnose,
)
from sbi_active.inference.regression.histories import Histories, HistoryRecord
from sbi_active.inference.regression.regions import (
    around,
    cover,
    whole_space,
)
from sbi_active.inference.regression.surrogate import Surrogate, fewest_rows
from sbi_active.inference.rounds.rows import UnexplainedOutcomeError
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.messages import warn
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation.outcomes import MissingRowsWarning

Array = NDArray[Any]


@dataclass(frozen=True)
class Task:
    """What is to be refined, as in :func:`.refine`.

    Attributes:
        stages: Settings of the stages.
    """

    simulator: Callable[..., Any]
    prior: Distribution
    action: Tensor
    outcome: Tensor
    hints: list[Distribution]
    settings: RefinementOptions
    stages: StageSettings = StageSettings()


class Stages:
    """The stages of one refinement: propose, simulate, fit, sample, judge."""

    def __init__(
        self,
        task: Task,
        past: HistoryRecord | None,
        seed: int,
        *,
        further_noise: Array | None = None,
    ) -> None:
        self.task, self.settings, self.seed = task, task.settings, seed
        self.own = task.stages
        self.rng = np.random.default_rng(derive_seed(seed, "refine"))
        self.coordinates = PriorCoordinates(task.prior, self.rng)
        observed = task.outcome.numpy().reshape(len(task.outcome), -1)
        self.histories = Histories(
            *(task.simulator, task.action, observed, self.coordinates),
            *(seed, past, self.settings.workers),
            further_noise=further_noise,
        )
        self.regions = [whole_space(self.coordinates.dim)]
        near: list[Array] = []
        for hint in task.hints:
            with forked_generators(derive_seed(seed, "start")):
                draws = hint.sample(torch.Size([1_000])).float()
            z = self.coordinates.to_z(draws)
            near.append(z[self.coordinates.inside(z)])
            self.regions.append(around(near[-1]))
        self.near = np.concatenate(near) if near else None
        self.course, self.num_forced = Course(self.own.small), 1
        self.least = max(self.own.fewest, 2 * fewest_rows(self.coordinates.dim))

    def run(self) -> LearnedBelief:
        """Return the belief of the last stage, or of one before that errs less."""
        fitted: list[Surrogate] = []
        while True:
            self._simulate(self._size())
            next_size = self._size()
            is_last = next_size < self.least
            surrogate = self._fit(is_cautious=not is_last)
            try:
                stage = self._sample(surrogate, self.near)
            except UnexplainedOutcomeError:
                if not self.course.stages:
                    raise
                break  # beyond what any parameters explain, closer is no better
            fitted.append(surrogate)
            if stage.error > self.own.small and self.course.stages:
                stage = self._with_more(stage)
            self.course.append(stage)
            if is_last or self.course.is_settled:
                break
            self._propose(stage, next_size)
        self.course.end_at_best()
        last = len(self.course.stages) - 1
        return self._learned(self.course.stages[last], fitted[last])

    def contradiction(self) -> Contradiction | None:
        """Return what contradicts at the draw that the last stage explains best."""
        stage, task = self.course.stages[-1], self.task
        t, label = len(task.action), stage.surrogate.assign(stage.draws)
        best: Array | None = None
        for k, fit in enumerate(stage.surrogate.regressions):
            if not (label == k).any():
                continue
            error, widening = fit.whitened(stage.draws[label == k])
            squares = (error.reshape(len(error), t, -1) ** 2).sum(2)
            squares = squares / np.minimum(widening, 2.0)[:, None]
            least = squares[squares.sum(1).argmin()]
            best = least if best is None or least.sum() < best.sum() else best
        if best is None:
            return None
        sds = torch.from_numpy(self.histories.noise_sds).mean(0)
        sds = torch.where(sds > 0, sds, torch.inf)
        return compared(
            task.action,
            task.outcome,
            lambda gap: gap.flatten(1) / sds,
            best,
            num_fitted=self.coordinates.dim,
        )

    def _size(self) -> int:
        """Return the histories of the next stage."""
        settings, used = self.settings, self.histories.num_drawn
        share = self.own.first_share if used == 0 else self.own.stage_share
        size = max(int(share * settings.num_histories), self.least)
        left = settings.num_histories - used
        # A remainder too small for a stage of its own goes to the one before.
        return left if left < size + self.least else size

    def _propose(self, stage: Stage, size: int) -> None:
        """Put the next stage's regions around what is still plausible."""
        many = 2 * max(self.num_forced, len(self.regions))
        fewer = max(1, self.num_forced // 2)
        self.num_forced = (
            min(many, self.own.max_forced) if self.course.is_stuck else fewer
        )
        limit = max(1, int(size / (1.2 * fewest_rows(self.coordinates.dim))))
        self.regions = cover(
            stage.draws,
            self.rng,
            min_regions=min(self.num_forced, limit),
            max_regions=min(max(self.own.max_regions, self.num_forced), limit),
            generous=stage.excess < 3,
        )
        self.near = stage.draws

    def _simulate(self, size: int) -> None:
        """Bring the stage's regions to their numbers, past histories first."""
        histories, regions = self.histories, self.regions
        is_first = histories.num_drawn == 0
        num_places = size - max(int(self.own.replicate_share * size), 12)
        shares = np.full(len(regions), 1 / len(regions))
        if is_first and len(regions) > 2:  # the overview keeps half of the stage
            shares = np.array([0.5, *[0.5 / (len(regions) - 1)] * (len(regions) - 1)])
        bounds = num_places * np.concatenate([[0.0], shares.cumsum()])
        counts = np.diff(np.round(bounds, 6).astype(int))
        for k, (region, count) in enumerate(zip(regions, counts, strict=True)):
            # The first stage's first region is the whole space, seen from the prior.
            is_overview = is_first and k == 0
            before = len(histories) - len(histories.second)
            histories.reuse(region, int(count), is_overview=is_overview)
            missing = int(count) - (len(histories) - len(histories.second) - before)
            if missing <= 0:
                continue
            z = region.sample_inside(missing, self.coordinates, self.rng)
            z = self.rng.permutation(z)
            if len(z) == 0:  # it lies beside the support, as of an outcome far away
                z = self.coordinates.sample_prior(missing, self.rng)
            num_replicates = missing * (size - num_places) // num_places
            histories.add(z, min(num_replicates, len(z)), is_overview=is_overview)

    def _fit(self, *, is_cautious: bool) -> Surrogate:
        """Return the regressions of the regions that have simulations enough."""
        histories = self.histories
        fits = [histories.regress(region) for region in self.regions]
        regressions = [fit for fit in fits if fit is not None]
        if regressions:
            return Surrogate(self.coordinates, regressions, is_cautious)
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

    def _sample(self, surrogate: Surrogate, near: Array | None) -> Stage:
        """Return the stage of a surrogate, its density sampled."""
        num = self.own.oversampling * self.settings.effective_of(self.coordinates.dim)
        fit = learned_fit(surrogate, self.rng, near=near, num_effective=num)
        if fit is None:
            raise UnexplainedOutcomeError(
                "expected outcomes that some parameters may explain; got none with a "
                "likelihood; correct the outcome, or leave the trial out"
            )
        return Stage.of(surrogate, fit, self.settings.defensive, self.rng)

    def _with_more(self, stage: Stage) -> Stage:
        """Return the stage with simulations from further off, where they are of use."""
        surrogate, bias = widened(
            self.histories, stage.surrogate, stage.error, stage.draws, self.rng
        )
        if surrogate is stage.surrogate:
            return stage
        wide = self._sample(surrogate, stage.draws)
        return replace(wide, error=wide.error + bias)

    def _learned(self, stage: Stage, fitted: Surrogate) -> LearnedBelief:
        """Return the belief of the last stage, and judge it.

        Measurements are judged by what was fitted before simulations from further off.
        """
        histories = self.histories
        diagnostics = diagnose(
            self.course,
            num_simulations=histories.num_simulations,
            share_invalid=histories.share_invalid,
            num_trials=len(self.task.action),
            rng=self.rng,
        )
        # The residuals have served the diagnostics and would only weigh on the pickle.
        empty = np.zeros((0, len(histories.used)))
        slim = [
            replace(fit, residual=empty, standardized=empty)
            for fit in stage.surrogate.regressions
        ]
        slim_potential = LearnedPotential(Surrogate(self.coordinates, slim))
        belief = LearnedBelief(
            self.task.prior,
            replace(stage.fit, potential=slim_potential),
            defensive=self.settings.defensive,
        )
        belief.diagnostics = check_outcomes(diagnostics, fitted, stage.draws, histories)
        belief.histories = histories.record()
        if histories.num_missing:
            warn(
                f"SA301 {histories.num_missing} of {histories.num_simulations} "
                "simulations of the refinement are missing, by faults of the "
                "simulator; the histories they belong to were left out",
                MissingRowsWarning,
                stacklevel=4,
            )
        return belief
