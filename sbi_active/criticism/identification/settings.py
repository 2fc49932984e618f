"""Settings of an identification."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.linear.fits import FitSettings
from sbi_active.criticism.linear.processes import Processes, time_scales


@dataclass(frozen=True, kw_only=True)
class IdentifySettings:
    """Settings of what is spent, and of what is told apart.

    Attributes:
        num_screened: Draws of the prior that are looked at, at least.
        screened_each: Draws looked at for each parameter: the more there are, the more
            optima.
        fit: Searches from these, at least, and how far they go.
        starts_each: Searches for each parameter.
        kept_each: Searches that go on, for each parameter.
        num_draws: Draws of the posterior: ends of a 95 % interval are then known to
            some 1 %.
        num_errors: Draws of the errors that the linear model is summed over.
        num_places: Draws of the coordinates without effects, and with all, by whose
            residuals these are drawn: one would know the errors' size too well.
        near: Nats behind the best set of effects up to which larger and smaller ones
            are looked at.
        step: Step of finite differences, in deviations of the prior.
        tried: Deviations of the prior by which an effect that is absent is tried: many
            are flat at their null.
        alias: Share of an effect's column that is no combination of the parameters'
            own, below which it is an alias of them.
        likely: Probability from which an effect is fitted.
        linearized: Times at most that the model is linearized anew.
        moved: Posterior deviations that the simulator at the posterior's mean may move
            it by, without which the model is linear enough: a tenth leaves a 95 %
            interval .1 % short.
        smallest: Residual that a channel is taken to have at least, in its deviations.
        shares: Shares of the variance that are white, of errors of unknown size.
        least: Smallest share of a declared white error: below it sums of squares lose
            their digits.
        num_compared: Draws at which the linear model is compared with the simulator.
        linear: Deviation of the log density ratio up to which it will do, nats: models
            that are linear have .1 at most, and half a nat misses one of eight
            posteriors of six parameters whose means are off by .6 deviations.
        most_simulated: Simulations of all trials that are spent where it will not.
        fewest: Effective draws of these below which a belief rests on the linear model,
            and is not to be trusted: few would make for a narrow interval.
        fewest_each: Effective draws as a multiple of d (d + 3) for d parameters, below
            which such a belief is not to be trusted, as for other beliefs.
        largest_shape: Shape of the tail of weights above which it is not either, as for
            other beliefs.
        fewest_parts: Parts of the trials at least, for which trials are divided in
            time.
        level: Tail probability below which they disagree.
        wider: Deviations between parts by which all of them may be off: with four
            parts Student's quantile is 3.2.
        beyond: Multiple of the declared deviation from which errors are no longer the
            sensor's.
        half: Deviation of half a Gaussian: beside a bound draws that are narrower say
            that trials ask for what is beyond it, and not how well they tell the
            parameter.
    """

    num_screened: int = 16
    screened_each: int = 5
    fit: FitSettings = FitSettings(num_starts=3, num_kept=1, first=5)
    starts_each: float = 1.0
    kept_each: float = 0.3
    num_draws: int = 2_000
    num_errors: int = 128
    num_places: int = 8
    near: float = 3.0
    step: float = 1e-4
    tried: float = 0.05
    alias: float = 0.02
    likely: float = 0.1
    linearized: int = 6
    moved: float = 0.1
    smallest: float = 1e-9
    shares: tuple[float, ...] = (1e-4, 1e-3, 0.01, 0.03, 0.1, 0.3, 0.6, 0.9)
    least: float = 1e-12
    num_compared: int = 16
    linear: float = 0.25
    most_simulated: int = 3_000
    fewest: int = 100
    fewest_each: float = 2.5
    largest_shape: float = 0.7
    fewest_parts: int = 4
    level: float = 0.01
    wider: float = 3.0
    beyond: float = 3.0
    half: float = 0.6

    def errors(self, m: Measurements, declared: float) -> Processes:
        """Return hypotheses of errors of size one, white noise first.

        Args:
            m: Measurements, which say what time scales can be told.
            declared: Share of the variance of residuals that a declared white error
                has at least in all channels; shares go on by tens to a tenth of it.
        """
        tens = np.log10(self.shares[0] / max(declared / 10, self.least))
        below = self.shares[0] * 10.0 ** -np.arange(max(np.ceil(tens), 0), 0, -1)
        share = np.array([*below, *self.shares])
        variances = np.stack([share, 1 - share], 1)
        return Processes.grid(variances, time_scales(m, m.trial)).beside_white()
