"""The one loop behind a learned likelihood: propose, simulate, fit, sample, judge.

What is simulated and what is fitted to it is a subclass: polynomials in regions
(:mod:`.regional`), or a Gaussian process a trial on few simulations (``emulation``).
The budget and where the loop ends are settings.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch.distributions import Distribution

from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.inference.declared.diagnosing import Doubt, judged
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.engine.learned import LearnedLikelihood, learned_fit
from sbi_active.inference.refinement.course import Stage, StageSettings
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
        stages: The stages so far.
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
        self.stages: list[Stage] = []
        self.least = own.fewest

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

    def with_more(self, stage: Stage) -> Stage:
        """Return the stage with more of the simulations, where these are of use."""
        return stage

    def last(self, stage: Stage) -> Stage:
        """Return the last stage, with what is worth its cost there alone."""
        return stage

    def run(self) -> LearnedBelief:
        """Return the belief of the last stage that explains the trials.

        Raises:
            UnexplainedOutcomeError: If nothing has a likelihood.
        """
        stages, near, own = self.stages, self.near, self.own
        size = self._size(own.first_share)
        while True:
            self.simulate(size)
            size = self._size(own.stage_share)
            is_last = size < self.least
            try:
                stage = self.sample(self.fit(near, is_last=is_last), near)
            except UnexplainedOutcomeError:
                if not stages:
                    raise
                break  # beyond what any parameters explain, closer is no better
            if stages:
                if stage.error > own.small:
                    stage = self.with_more(stage)
                stage = stage.after(stages[-1])
            stages.append(stage)
            if is_last or stage.is_settled(own):
                break
            near = stage.draws
        stages[-1] = self.last(stages[-1])
        belief = LearnedBelief(
            self.prior, stages[-1].fit, defensive=self.settings.defensive
        )
        belief.diagnostics = self._diagnosed()
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
        judged = self.judged(surrogate, draws)
        return Stage(surrogate, fit, self.settings.defensive, draws, *judged)

    def _diagnosed(self) -> Diagnostics:
        """Return figures about the last stage, what it assumes, and warnings."""
        last, own, num = self.stages[-1], self.own, len(self.stages)
        edge = np.abs(last.draws[:, self.coordinates.bounded]) > 0.98
        edge_mass = float(edge.mean(0).max(initial=0.0))
        effective = min(stage.fit.efficiency for stage in self.stages)
        change = last.change if num > 1 else -1.0
        allowed = own.unsettled * last.draws.shape[1]
        tails = self.tails(last)
        doubts: dict[str, Doubt] = {
            "few_modes": (
                effective >= own.effective,
                effective,
                "SA111 at some stage only {:.1%} of the particles counted, as with "
                "many narrow modes, and a mode may be lost; raise num_histories",
            ),
            "settled": (
                not np.isfinite(own.settled) or (num > 1 and change <= allowed),
                change,
                "SA109 the last stage still changed the belief, by {:.2g} nats; raise "
                "num_histories",
            ),
            "small_error": (
                last.error <= own.untrusted,
                last.error,
                "SA105 the belief is off by about {:.2g} nats, since it rests on few "
                "simulations for so many parameters and numbers; raise num_histories",
            ),
            **self.doubts(),
        }
        return judged(
            doubts,
            tails,
            edge_mass,
            num_simulations=self.spent()[1],
            effective_sample_size=float(last.fit.effective_sample_size),
            error_nats=last.error,
            error_nats_if_explained=last.error,
            figures={
                "num_stages": num,
                "num_regions": len(last.mass),
                "region_mass": [float(mass) for mass in last.mass],
                "prior_edge_mass": edge_mass,
                "surrogate_kl_last_stage": change,
            },
        )
