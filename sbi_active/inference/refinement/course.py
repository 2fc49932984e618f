"""What the loop of learned likelihoods decides by: its settings and its stages."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.inference.engine.learned import LearnedFit
from sbi_active.inference.regression.residuals import ShapeSettings
from sbi_active.inference.regression.surrogate import MISFIT

Array = NDArray[Any]

LIVE = 0.01  # mass below which a region is left out of the checks


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
            not trusted. At .125, of twenty beliefs of ``dear.skewed`` at 3,000
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
    effective: float = 0.05


@dataclass(frozen=True)
class Stage:
    """One stage: learned likelihood, its sample and its normalized log density.

    Attributes:
        surrogate: Learned likelihood.
        fit: Posterior of the surrogate.
        defensive: Share of the prior in the density.
        draws: Equally weighted particles, shape (n, d).
        excess: Worst misfit of a region with mass.
        mass: Mass of each region, shape (k,).
        error: Expected divergence in nats, as the simulations are finite in number.
        change: Nats by which it changed the belief; inf of the first.
        shrinkage: Nats by which the belief's entropy fell.
    """

    surrogate: Any
    fit: LearnedFit
    defensive: float
    draws: Array
    excess: float
    mass: Array
    error: float
    change: float = np.inf
    shrinkage: float = np.inf

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
        if self.excess > MISFIT or self.error > own.small:
            return False
        most = self.draws.shape[1] * np.array([own.settled, 0.1])
        return not np.isfinite(own.settled) or bool(
            self.change < most[0] and self.shrinkage < most[1]
        )
