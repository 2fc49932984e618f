"""What the loop behind a learned likelihood decides by."""

from __future__ import annotations

from dataclasses import dataclass, field

from sbi_active.inference.regression.noise_shape import ShapeSettings


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
