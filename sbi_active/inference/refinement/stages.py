"""The one loop behind a learned likelihood: propose, simulate, fit, sample, judge.

What is simulated and what is fitted to it is a subclass: polynomials in regions
(:mod:`.regional`), or a Gaussian process a trial on few simulations (``emulation``).
The budget and where the loop ends are settings.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch.distributions import Distribution

from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.engine.learned import LearnedLikelihood, learned_fit
from sbi_active.inference.refinement.course import (
    Course,
    Doubt,
    Stage,
    StageSettings,
    diagnose,
)
from sbi_active.inference.refinement.learned_belief import LearnedBelief
from sbi_active.inference.rounds.rows import UnexplainedOutcomeError
from sbi_active.inference.sampling.coordinates import PriorCoordinates

Array = NDArray[Any]


class Stages(ABC):
    """The stages of one belief.

    Args:
        prior: The original prior.
        settings: Settings of the belief.
        own: Settings of the stages.
        budget: Most that may be spent, in what is drawn: histories, or rows.
        rng: Source of all draws.
        coordinates: Coordinates of the prior.

    Attributes:
        course: The stages so far.
        near: Coordinates of draws of a guess, shape (n, d), or None.
        least: Simulations below which another stage adds nothing.
    """

    near: Array | None = None

    def __init__(
        self,
        prior: Distribution,
        settings: RefinementOptions,
        own: StageSettings,
        budget: int,
        rng: np.random.Generator,
        coordinates: PriorCoordinates,
    ) -> None:
        self.prior, self.settings, self.own = prior, settings, own
        self.budget, self.rng, self.coordinates = budget, rng, coordinates
        self.course, self.least = Course(own), own.fewest

    @abstractmethod
    def spent(self) -> tuple[int, int]:
        """Return what was spent of the budget, and the rows simulated."""

    @abstractmethod
    def simulate(self, size: int) -> None:
        """Spend so much where the last stage says that it is of use."""

    @abstractmethod
    def fit(self, near: Array | None, *, is_last: bool) -> LearnedLikelihood:
        """Return the likelihood fitted to the simulations, near draws (n, d)."""

    @abstractmethod
    def judged(self, surrogate: Any, draws: Array) -> tuple[float, Array, float]:
        """Return misfit, mass of each region and expected error at draws (n, d)."""

    @abstractmethod
    def tails(self, stage: Stage) -> tuple[list[float], float]:
        """Return tail probabilities of the trials and of all together."""

    def doubts(self) -> dict[str, Doubt]:
        """Return what else is taken for granted, by name."""
        return {}

    def with_more(self, stage: Stage) -> tuple[Any, float]:
        """Return a likelihood of more simulations, and what it may err beyond."""
        return stage.surrogate, 0.0

    def last(self, stage: Stage) -> Stage:
        """Return the last stage, with what is worth its cost there alone."""
        return stage

    def run(self) -> LearnedBelief:
        """Return the belief of the last stage, or of one before that errs less.

        Raises:
            UnexplainedOutcomeError: If nothing has a likelihood.
        """
        course, near = self.course, self.near
        size = self._size(self.own.first_share)
        while True:
            self.simulate(size)
            size = self._size(self.own.stage_share)
            is_last = size < self.least
            surrogate = self.fit(near, is_last=is_last)
            try:
                stage = self.sample(surrogate, near)
            except UnexplainedOutcomeError:
                if not course.stages:
                    raise
                break  # beyond what any parameters explain, closer is no better
            if stage.error > self.own.small and course.stages:
                wider, bias = self.with_more(stage)
                if wider is not surrogate:
                    wide = self.sample(wider, stage.draws)
                    stage = replace(wide, fitted=surrogate, error=wide.error + bias)
            course.append(stage)
            if is_last or course.is_settled:
                break
            near = stage.draws
        course.end_at_best()
        stage = course.stages[-1] = self.last(course.stages[-1])
        belief = LearnedBelief(self.prior, stage.fit, defensive=self.settings.defensive)
        belief.diagnostics = diagnose(
            course,
            self.doubts(),
            tails=self.tails(stage),
            num_simulations=self.spent()[1],
            bounded=self.coordinates.bounded,
        )
        return belief

    def _size(self, share: float) -> int:
        """Return what the next stage spends, of a share of the budget."""
        if share == 0:  # there are simulations to begin with
            return 0
        size, left = max(int(share * self.budget), self.least), self.budget
        left -= self.spent()[0]
        # A remainder too small for a stage of its own goes to the one before.
        return left if left < size + self.least else size

    def sample(self, surrogate: LearnedLikelihood, near: Array | None) -> Stage:
        """Return the stage of a likelihood, its density sampled."""
        num = self.own.oversampling * self.settings.effective_of(self.coordinates.dim)
        fit = learned_fit(surrogate, self.rng, near=near, num_effective=num)
        if fit is None:
            raise UnexplainedOutcomeError(
                "expected outcomes that some parameters may explain; got none with a "
                "likelihood; correct the outcome, or leave the trial out"
            )
        draws = fit.draws(1_000, self.rng)
        excess, mass, error = self.judged(surrogate, draws)
        stage = Stage(
            *(surrogate, surrogate, fit, self.settings.defensive, draws),
            *(excess, mass, 0.0, error),
        )
        return replace(stage, entropy=-float(stage.log_prob(draws).mean()))
