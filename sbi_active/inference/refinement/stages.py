"""The one loop behind a learned likelihood: propose, simulate, fit, sample, judge.

What is simulated and what is fitted to it is a subclass: polynomials in regions
(:mod:`.regional`), or a Gaussian process a trial on few simulations (``emulation``).
The budget and where the loop ends are settings.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from torch.distributions import Distribution

from sbi_active.arrays import Array
from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.inference.declared.diagnosing import Doubt, judged
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.engine.learned import (
    LearnedBelief,
    LearnedFit,
    LearnedLikelihood,
    learned_fit,
)
from sbi_active.inference.regression.residuals import ShapeSettings
from sbi_active.inference.regression.surrogate import is_misfit
from sbi_active.inference.rounds.rows import UnexplainedOutcomeError
from sbi_active.inference.sampling.coordinates import PriorCoordinates


@dataclass(frozen=True, kw_only=True)
class StageSettings:
    """Settings of the stages: propose, simulate, fit, sample, judge.

    Attributes:
        first_share: Share of the budget for the first stage, over the whole prior. It
            must find every mode; what it spends is lost where the posterior is narrow.
        stage_share: Share for each later stage.
        replicate_share: Share of a stage simulated twice, which tells noise from
            misfit.
        fewest: Histories below which another stage adds nothing; more by dimension.
        oversampling: Number of effective draws of a learned likelihood for each that
            is asked of a simulated one. Half raises the error of a log density from
            .018 to .025 nats at 200.
        max_regions: Number of ellipsoids at most.
        small: Nats by which the belief is off for want of simulations that need no
            further stage.
        settled: Nats a dimension that the last stage may have changed for there to be
            no further one; infinite asks nothing, where the error is known better.
        untrusted: Nats off, by the number of simulations, that call for a warning.
        checked_share: Share of the budget that is simulated beyond it, to compare a
            learned belief with simulations that it was not fitted to. A mean is then
            known to about .06 standard deviations at 3,000 histories; with half the
            share to .08.
        largest_shift: Error of a learned belief's mean, in standard deviations, beyond
            which it is not trusted, or three standard errors of the check where these
            are more. Less than the .3 that a user may see, by two standard errors at
            3,000 histories.
        known: Error of a mean by the number of simulations, in standard deviations,
            root mean square, beyond which a belief under noise that is not Gaussian is
            not trusted. At .125, of twenty beliefs under skewed noise at 3,000
            histories all are trusted, and six have a mean that is off by more than .3:
            what is wrong with the noise's shape counts as well. This trusts none of
            them, and half none of any.
        shapes: Settings of noise that is not Gaussian.
        least_checked: Number of histories of a check at least.
        step: Step of the differences of a check, in deviations of the belief.
        chance: Standard errors of a shift below which it may be chance.
        flat: Precision that stands for a uniform prior in [-1, 1].
        rough: Share of the variance that a cubic may miss over the whole prior.
        misfit: Residual over noise variance, chance removed, beyond which a
            belief is doubted.
        unsettled: Nats a dimension that the last stage may have changed in a
            belief to be trusted.
        correlated: Correlation of errors across trials beyond which they are taken to
            depend on each other; misfit below its limit reaches half of this.
        blurred: Share of repeated simulations that would differ, beyond those that do.
        rare: Probability of a trial's outcome, a measurement or none, below which the
            simulator is doubted.
        live: Mass below which a region is left out of the checks (a choice).
        effective: Share of the particles that must count at each stage, or a
            mode may be lost.
    """

    first_share: float = 0.25
    stage_share: float = 0.15
    replicate_share: float = 0.2
    fewest: int = 60
    oversampling: float = 16.0
    max_regions: int = 8
    small: float = 0.01
    settled: float = 0.03
    untrusted: float = 0.1
    checked_share: float = 0.1
    largest_shift: float = 0.2
    known: float = 0.0625
    shapes: ShapeSettings = field(default_factory=ShapeSettings)
    least_checked: int = 20
    step: float = 0.05
    chance: float = 3.0
    flat: float = 3.0
    rough: float = 0.5
    misfit: float = 1.5
    unsettled: float = 0.1
    correlated: float = 0.25
    blurred: float = 0.05
    rare: float = 0.01
    live: float = 0.01
    effective: float = 0.05


@dataclass(frozen=True)
class Stage:
    """One stage: learned likelihood, its sample and its normalized log density.

    Attributes:
        fit: Posterior of a learned likelihood.
        defensive: Share of the prior in the density.
        draws: Equally weighted particles, shape (n, d).
        excess: Worst misfit of a region with mass.
        mass: Mass of each region, shape (k,).
        error: Expected divergence in nats, as the simulations are finite in number.
        change: Nats by which it changed the belief; inf of the first.
        shrinkage: Nats by which the belief's entropy fell.
    """

    fit: LearnedFit
    defensive: float
    draws: Array
    excess: float
    mass: Array
    error: float
    change: float = np.inf
    shrinkage: float = np.inf

    @property
    def surrogate(self) -> Any:
        """The learned likelihood."""
        return self.fit.potential.learned

    def log_prob(self, z: Array) -> Array:
        """Return the log density of the belief at this stage, shape (n,)."""
        log_prior = self.surrogate.coordinates.log_prior(z)
        log_likelihood = self.surrogate.log_likelihood(z)
        return log_prior + np.logaddexp(
            np.log1p(-self.defensive) + log_likelihood - self.fit.log_evidence,
            np.log(self.defensive),
        )

    @cached_property
    def entropy(self) -> float:
        """Entropy of the density, in nats."""
        return -float(self.log_prob(self.draws).mean())

    def after(self, last: Stage) -> Stage:
        """Return the stage with what it changed of the last."""
        change = float(-self.entropy - last.log_prob(self.draws).mean())
        shrinkage = last.entropy - self.entropy
        return replace(self, change=change, shrinkage=shrinkage)

    def is_settled(self, own: StageSettings) -> bool:
        """Return whether residuals are noise and the stage changed nothing."""
        if is_misfit(self.excess) or self.error > own.small:
            return False
        most = self.draws.shape[1] * np.array([own.settled, 0.1])
        return not np.isfinite(own.settled) or bool(
            self.change < most[0] and self.shrinkage < most[1]
        )


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
    def tails(self, stage: Stage) -> list[float]:
        """Return tail probabilities of the trials and, last, of all together."""

    def doubts(self) -> tuple[dict[str, Doubt], dict[str, Any]]:
        """Return what else is taken for granted, by name, and details of that."""
        return {}, {}

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
        num = self.own.oversampling * self.settings.num_effective
        fit = learned_fit(surrogate, self.rng, near=near, num_effective=num)
        draws = fit.draws(1_000, self.rng)
        judged = self.judged(surrogate, draws)
        return Stage(fit, self.settings.defensive, draws, *judged)

    def _diagnosed(self) -> Diagnostics:
        """Return figures about the last stage, what it assumes, and warnings."""
        last, own, num = self.stages[-1], self.own, len(self.stages)
        edge = np.abs(last.draws[:, self.coordinates.bounded]) > 0.98
        edge_mass = float(edge.mean(0).max(initial=0.0))
        effective = min(stage.fit.efficiency for stage in self.stages)
        change = last.change if num > 1 else -1.0
        allowed = own.unsettled * last.draws.shape[1]
        tails = self.tails(last)
        is_settled = not np.isfinite(own.settled) or (num > 1 and change <= allowed)
        further, details = self.doubts()
        doubts: dict[str, Doubt] = {
            "few_modes": (effective >= own.effective, effective),
            "settled": (is_settled, change),
            "small_error": (last.error <= own.untrusted, last.error),
            **further,
        }
        return judged(
            *(doubts, details, tails, edge_mass),
            num_simulations=self.spent()[1],
            effective_sample_size=float(last.fit.effective_sample_size),
            error_nats=last.error,
            error_nats_if_explained=last.error,
            figures={"num_stages": num, "prior_edge_mass": edge_mass},
        )
