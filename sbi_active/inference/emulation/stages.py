"""Stages of the loop of a learned likelihood, its settings, and what weighs one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sbi_active.arrays import Array
from sbi_active.inference.emulation.emulator import (
    EmulatedLikelihood,
    Interpolation,
)
from sbi_active.inference.emulation.pool import TrialRows
from sbi_active.inference.emulation.residuals import ShapeSettings
from sbi_active.inference.engine.learned import LearnedBelief, LearnedFit
from sbi_active.inference.sampling.weights import log_sum_exp


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


def largest_error(
    fits: Sequence[LearnedFit],
    learned: EmulatedLikelihood,
    rows: Sequence[TrialRows],
    z: Array,
    *,
    least: float = -4.0,
) -> float:
    r"""Return the largest error of a log weight at places, nats.

    Weights of the simulated likelihood and of the learned one, each by its mean,

    .. math::
        w_i = \frac{\prod_k p(x_k | f(\theta_i, \xi_k))}{q(\theta_i)}, \qquad
        \hat w_i = \frac{\hat p(x | \theta_i)}{q(\theta_i)}, \qquad
        q = \sum_j \frac{\hat p_j(x | \theta_i)}{Z_j} .

    Places of which a row was lost are left out.

    Args:
        fits: Fits j that gave the places, as many each.
        learned: Learned likelihood.
        rows: Simulations of each trial, those at the places among them.
        z: Places, shape (n, d).
        least: Log weight below which a place counts for nothing, a fiftieth.
    """
    at = [_places_of(own.z, z) for own in rows]
    log_ratios = [
        fit.potential.learned.log_likelihood(z) - fit.log_evidence for fit in fits
    ]
    log_q = log_sum_exp(np.stack(log_ratios), 0)
    # In single precision a draw at the edge of a region may be beyond it.
    kept = np.isfinite(log_q) & np.all([place >= 0 for place in at], axis=0)
    if not kept.any():
        return np.inf
    z, log_q, at = z[kept], log_q[kept], [place[kept] for place in at]
    simulated = np.zeros(len(z))
    for part, group in zip(learned.parts, learned.groups, strict=True):
        assert isinstance(part, Interpolation)
        simulated += part.simulated(rows[group[0]].x[at[group[0]]])
    agrees = [own.agrees[place] for own, place in zip(rows, at, strict=True)]
    simulated = np.where(np.all(agrees, axis=0), simulated, -np.inf)
    if not np.isfinite(simulated).any():
        return np.inf
    log_weights = []
    for log_likelihood in (simulated, learned.log_likelihood(z)):
        log_weight = log_likelihood - log_q
        mean = log_sum_exp(log_weight) - np.log(len(z))
        log_weights.append(np.maximum(log_weight - mean, least))
    return float(np.abs(log_weights[0] - log_weights[1]).max())


def _places_of(known: Array, z: Array) -> NDArray[np.intp]:
    """Return where each of places (n, d) is among those known, (n,); -1 if nowhere."""
    same = (known == z[:, None]).all(2)
    return np.where(same.any(1), same.argmax(1), -1)
