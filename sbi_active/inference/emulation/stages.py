"""Stages of the loop of a learned likelihood, and its settings."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from sbi_active.arrays import Array
from sbi_active.inference.emulation.emulator import EmulatedLikelihood
from sbi_active.inference.emulation.residuals import ShapeSettings
from sbi_active.inference.engine.learned import LearnedBelief, LearnedFit


@dataclass(frozen=True, kw_only=True)
class EmulationSettings:
    """Settings of the loop.

    Attributes:
        first_share: Share of the budget for the first stage, over the whole prior. It
            must find every mode; what it spends is lost where the posterior is narrow.
        stage_share: Share for each later stage.
        replicate_share: Share of a stage simulated twice, which tells noise from
            misfit.
        fewest: Rows of each action below which another stage adds nothing; more by
            dimension.
        share_of_prior: Share of a later stage that is drawn from the prior.
        far: Factor of the width of half of a stage's draws: the further apart
            simulations are, the better they tell slopes.
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
        shapes: Settings of noise that is not Gaussian; None takes it for Gaussian.
        least_checked: Number of histories of a check at least.
        num_weighed: Number of places, each simulated at all actions before the loop
            ends, at which the learned likelihood is compared with the simulated one. A
            part of the belief that is wrong and has a fifth of its mass is missed by
            all eight draws of the belief once in six times, by four twice in five.
        weighed_share: Share of the budget that these may take. With .25, of ten jumps
            at 300 rows one was missed by a belief that was trusted.
        off: Error of a log weight at one of them, in nats, beyond which the loop goes
            on, or the belief is not trusted: of steep responses without a jump the
            largest was 1.4, and of a place that is lost it is 4.
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
    share_of_prior: float = 0.1
    far: float = 3.0
    small: float = 0.01
    settled: float = 0.03
    untrusted: float = 0.1
    checked_share: float = 0.1
    largest_shift: float = 0.2
    known: float = 0.0625
    shapes: ShapeSettings | None = field(default_factory=ShapeSettings)
    least_checked: int = 20
    num_weighed: int = 0
    weighed_share: float = 0.4
    off: float = 2.5
    rough: float = 0.5
    misfit: float = 1.5
    unsettled: float = 0.1
    correlated: float = 0.25
    blurred: float = 0.05
    rare: float = 0.01
    effective: float = 0.05


#: The loop of few simulations. It begins with rows that are there, and ends where the
#: processes' own errors are small: no stage is spent on seeing that one more changes
#: nothing. Of noise that the simulator draws a check would take more than a belief has.
FEW_ROWS = EmulationSettings(
    first_share=0.0,
    stage_share=0.35,
    replicate_share=0.0,
    fewest=12,
    settled=np.inf,
    checked_share=0.0,
    num_weighed=16,
    shapes=None,
)


@dataclass(frozen=True)
class Stage:
    """One stage: a learned likelihood, and the belief of it.

    Attributes:
        learned: The learned likelihood.
        fit: Its posterior.
        belief: Belief with a share of the prior.
        draws: Equally weighted particles, shape (n, d).
        errors: Expected divergence in nats, as the simulations are finite in number, by
            part of the likelihood.
        change: Nats by which it changed the belief; inf of the first.
    """

    learned: EmulatedLikelihood
    fit: LearnedFit
    belief: LearnedBelief
    draws: Array
    errors: Array
    change: float = np.inf

    @property
    def error(self) -> float:
        """Expected divergence in nats, of parts that err independently."""
        return float(self.errors.sum())

    def after(self, last: Stage) -> Stage:
        """Return the stage with what it changed of the last."""
        theta = self.learned.coordinates.to_theta(self.draws)
        change = self.belief.log_prob(theta) - last.belief.log_prob(theta)
        return replace(self, change=float(change.mean()))
