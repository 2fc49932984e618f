"""The stages so far: what each found, and whether to go on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.inference.engine.learned import LearnedFit
from sbi_active.inference.refinement.settings import StageSettings
from sbi_active.inference.regression.surrogate import MISFIT

Array = NDArray[Any]

UNSETTLED = 0.1  # nats a dimension


@dataclass(frozen=True)
class Stage:
    """One stage: learned likelihood, its sample and its normalized log density.

    Attributes:
        surrogate: Likelihood, with simulations from further off where they are of use.
        fitted: Likelihood fitted to the simulations nearby.
        fit: Posterior of the surrogate.
        defensive: Share of the prior in the density.
        draws: Equally weighted particles, shape (n, d).
        excess: Worst misfit of a region with mass.
        mass: Mass of each region, shape (k,).
        entropy: Entropy of the density, in nats.
        error: Expected divergence in nats, as the simulations are finite in number.
    """

    surrogate: Any
    fitted: Any
    fit: LearnedFit
    defensive: float
    draws: Array
    excess: float
    mass: Array
    entropy: float
    error: float

    def log_prob(self, z: Array) -> Array:
        """Return the log density of the belief at this stage, shape (n,)."""
        log_prior = self.surrogate.coordinates.log_prior(z)
        log_likelihood = self.surrogate.log_likelihood(z)
        return log_prior + np.logaddexp(
            np.log1p(-self.defensive) + log_likelihood - self.fit.fit.log_evidence,
            np.log(self.defensive),
        )


@dataclass
class Course:
    """The stages so far and whether to go on.

    Attributes:
        own: Settings of the stages.
    """

    own: StageSettings
    stages: list[Stage] = field(default_factory=list)
    divergences: list[float] = field(default_factory=list)
    shrinkage: float = np.inf

    @property
    def divergence(self) -> float:
        """Nats by which the last stage changed the belief; inf of the first."""
        return self.divergences[-1]

    def append(self, stage: Stage) -> None:
        """Record a stage, and by how much it changed the belief."""
        self.divergences.append(np.inf)
        if self.stages:
            last = self.stages[-1]
            change = stage.log_prob(stage.draws) - last.log_prob(stage.draws)
            self.divergences[-1] = float(change.mean())
            self.shrinkage = last.entropy - stage.entropy
        self.stages.append(stage)

    def end_at_best(self) -> None:
        """Leave out last stages that err more than one without misfit before them.

        Unless the stage after that one differs from it by more than its own error: what
        is missed far off has no part in the expected error. It is settled if the stage
        after it, or it, changed nothing.
        """
        errors = [s.error if s.excess <= MISFIT else np.inf for s in self.stages]
        best = len(errors) - 1
        for k in range(1, len(errors) - 1):
            best = k if errors[k] < errors[best] else best
        if self.stages[-1].error <= self.own.small or best == len(errors) - 1:
            return
        allowed = UNSETTLED * self.stages[-1].draws.shape[1]
        if self.divergences[best + 1] > allowed + self.stages[best + 1].error:
            return
        self.divergences[best] = min(self.divergences[best : best + 2])
        del self.stages[best + 1 :], self.divergences[best + 1 :]

    @property
    def is_settled(self) -> bool:
        """Whether residuals are noise and the last stage changed nothing."""
        stage = self.stages[-1]
        is_good = stage.excess <= MISFIT and stage.error <= self.own.small
        if not np.isfinite(self.own.settled):
            return is_good
        d = stage.draws.shape[1]
        is_still = self.divergence < self.own.settled * d and self.shrinkage < 0.1 * d
        return is_good and is_still

    @property
    def is_stuck(self) -> bool:
        """Whether misfit remains though the last stage learned nothing."""
        stage = self.stages[-1]
        return stage.excess > MISFIT and self.divergence < 0.3 and self.shrinkage < 0.3
