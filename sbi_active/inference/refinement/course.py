"""What the loop decides by, the stages so far, and how far to trust their belief."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.inference.beliefs.diagnostics import Assumption, Diagnostics
from sbi_active.inference.declared.diagnosing import misplaced
from sbi_active.inference.engine.learned import LearnedFit
from sbi_active.inference.regression.residuals import ShapeSettings
from sbi_active.inference.regression.surrogate import MISFIT

Array = NDArray[Any]

#: Whether something that is taken for granted holds, its figure, and what to say with
#: that where it does not.
Doubt = tuple[bool, float, str]
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
        max_regions: Number of ellipsoids at most, but for splits against misfit.
        max_forced: Number of ellipsoids that split misfit, at most.
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
        effective: Share of the particles that must count at each stage, or a
            mode may be lost.
    """

    first_share: float = 0.25
    stage_share: float = 0.15
    replicate_share: float = 0.2
    fewest: int = 60
    oversampling: float = 16.0
    max_regions: int = 8
    max_forced: int = 32
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
    effective: float = 0.05


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
        allowed = self.own.unsettled * self.stages[-1].draws.shape[1]
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


def diagnose(
    course: Course,
    doubts: dict[str, Doubt],
    *,
    tails: tuple[list[float], float],
    num_simulations: int,
    bounded: NDArray[np.bool_],
) -> Diagnostics:
    """Return figures about the last stage, what it assumes, and warnings in words.

    Args:
        course: Stages so far.
        doubts: Further things that are taken for granted, by name.
        tails: Tail probabilities of the trials, and of all together.
        num_simulations: Rows simulated.
        bounded: Parameters with two bounds, shape (d,).
    """
    last, own = course.stages[-1], course.own
    edge = np.abs(last.draws[:, bounded]) > 0.98
    edge_mass = float(edge.mean(0).max(initial=0.0))
    effective = min(stage.fit.efficiency for stage in course.stages)
    change = course.divergence if len(course.stages) > 1 else -1.0
    allowed = own.unsettled * last.draws.shape[1]
    all_doubts: dict[str, Doubt] = {
        "few_modes": (
            effective >= own.effective,
            effective,
            "SA111 at some stage only {:.1%} of the particles counted, as with "
            "many narrow modes, and a mode may be lost; raise num_histories",
        ),
        "settled": (
            not np.isfinite(own.settled)
            or (len(course.stages) > 1 and change <= allowed),
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
        **doubts,
    }
    warnings = [
        text.format(figure) for ok, figure, text in all_doubts.values() if not ok
    ]
    warnings += misplaced(*tails, edge_mass)
    figures: dict[str, Any] = {
        "num_stages": len(course.stages),
        "num_regions": len(last.mass),
        "region_mass": [float(mass) for mass in last.mass],
        "prior_edge_mass": edge_mass,
        "surrogate_kl_last_stage": change,
    }
    return Diagnostics(
        trustworthy=not warnings,
        warnings=(*warnings,),
        assumptions={
            name: Assumption(bool(ok), float(figure))
            for name, (ok, figure, _) in all_doubts.items()
        },
        num_simulations=num_simulations,
        effective_sample_size=float(last.fit.fit.effective_sample_size),
        error_nats=last.error,
        error_nats_if_explained=last.error,
        tail_probability=tails[1],
        tail_probability_of_trial=(*tails[0],),
        figures=figures,
    )
