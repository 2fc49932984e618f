"""Results of each step of the closed loop, as plain data."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import pandas as pd

from sbi_active.arrays import Array
from sbi_active.criticism.contradictions import (
    Bounds,
    Misfit,
    MissedTrial,
    OutlyingTrial,
)
from sbi_active.criticism.data.measurements import shared_errors
from sbi_active.criticism.effects.effect import Effect

#: What is no effect: the bare model, the residual process, noise inflation, and a gross
#: error of one trial.
NONE, UNEXPLAINED, SCATTER, OUTLIER = "none", "unexplained", "scatter", "outlier"
CATCH_ALLS = (UNEXPLAINED, SCATTER, OUTLIER)


@dataclass(frozen=True)
class ModelKey:
    """Key of a model of the trials, as ``rivals.fit(key)`` takes it.

    ``str(key)`` is its name in reports and results.

    Attributes:
        effects: Names of the effects, in the order of the library.
        error: A catch-all; None for the noise alone.

    Example:
        >>> str(ModelKey()), str(ModelKey(("drag", "bias")))
        ('none', 'drag + bias')
        >>> ModelKey.of("scatter")
        ModelKey(effects=(), error='scatter')
    """

    effects: tuple[str, ...] = ()
    error: str | None = None

    @classmethod
    def of(cls, name: str) -> ModelKey:
        """Return the key of "none", a catch-all or one effect."""
        if name in CATCH_ALLS:
            return cls(error=name)
        return cls(() if name == NONE else (name,))

    def without(self, name: str) -> ModelKey:
        """Return the key without one effect."""
        return ModelKey(tuple(n for n in self.effects if n != name), self.error)

    @property
    def parts(self) -> list[ModelKey]:
        """The sets with one effect less."""
        return [self.without(name) for name in self.effects]

    def __str__(self) -> str:
        error = () if self.error is None else (self.error,)
        return " + ".join((*self.effects, *error)) or NONE


@dataclass(frozen=True, kw_only=True)
class Residuals:
    r"""Standardized residuals, :math:`(x - \mu) / s` under a posterior predictive.

    Attributes:
        action: Actions, shape (t, action_dim).
        index: Place of each trial, shape (t,).
        times: Sample times, shape (k,) or (t, k); None without a time axis.
        x: Observations, shape (t, *x_shape), NaN where masked.
        mean: Posterior predictive mean of the model refitted to all trials, shape of x.
        sd: Predictive standard deviation, noise included, shape of x.
        refitted: (x - mean) / sd, shape of x.
        correlation: Correlation of neighboring noise errors along the time axis,
            posterior mean; 0 without a time axis.
        noise: "declared", "estimated" (from repeats or the trajectories themselves), or
            "stochastic" (the simulator is the draw).
        probability_valid: Probability that each trial has a measurement, shape (t,);
            None if it was not computed.
        roughness: Deviation of the simulator, which jumps, from any smooth function of
            its parameters, shape of x; it counts as noise here. None if it is
            smooth.
        names: Names of the trials.
    """

    action: Array
    index: Array
    times: Array | None
    x: Array
    mean: Array
    sd: Array
    refitted: Array
    correlation: float
    noise: Literal["declared", "estimated", "stochastic"]
    names: tuple[str, ...]
    probability_valid: Array | None = None
    roughness: Array | None = None

    @property
    def alike(self) -> float:
        """Tail probability of errors as alike at the same times of all trials."""
        if self.times is None:
            return 1.0
        z = self.refitted.reshape(len(self.x), self.x.shape[1], -1)
        z = z[:, 1:] - self.correlation * z[:, :-1]  # white but for what is shared
        places = np.arange(z.shape[2]), self.times[..., 1:, None]
        own = np.stack([np.broadcast_to(place, z.shape) for place in places])
        seen = np.isfinite(z)
        return shared_errors(z[seen], own[:, seen])[1]


@dataclass(frozen=True, kw_only=True)
class Evidence:
    r"""Marginal likelihood of one model, :math:`\log Z = \log \int p(x|z) p(z) dz`.

    Attributes:
        key: Key of the model.
        log_evidence: log Z, nats.
        standard_error: Standard error of log Z, Monte Carlo, nats.
        effective_sample_size: Number of draws that count.
        engine: Method that gave the evidence: "importance" sampling around least
            squares, "smc" (sequential Monte Carlo), or "linear".
        names: Names of the coordinates (theta, phi).
        draws: Posterior draws of (theta, phi), shape (m, dim).
        best: Best fit of theta and phi, (dim,), of a model that misses, whose draws are
            wide; or None.
        narrow: Draws of its posterior beside the sensor's error alone, which densities
            of trials go with, if it misses; or None.
    """

    key: ModelKey
    log_evidence: float
    standard_error: float
    effective_sample_size: float
    engine: str
    names: tuple[str, ...]
    draws: Array
    best: Array | None = None
    narrow: Array | None = None

    @property
    def name(self) -> str:
        """Name of the model in reports."""
        return str(self.key)

    @property
    def moments(self) -> dict[str, tuple[float, float]]:
        """Mean and deviation of each coordinate; the best fit of a model that misses.

        Draws of that are within the prior: their mean is no fit.
        """
        num = len(self.names)  # beyond these there may be draws of errors
        center = self.draws[:, :num].mean(0) if self.best is None else self.best[:num]
        pairs = zip(center.tolist(), self.draws.std(0).tolist(), strict=False)
        return dict(zip(self.names, pairs, strict=False))


@dataclass(frozen=True, kw_only=True)
class Detection:
    r"""Whether the bare model, refitted, still misses the data.

    Attributes:
        log_bayes_factor: Log Bayes factor of the mixture of effects and catch-alls
            against the bare model, nats.
        threshold: log 20.
        chi_square: Smallest whitened residual sum of squares of the bare model.
        degrees_of_freedom: Measurements less the parameters that they determine.
        p_value: p-value of that chi-square; anti-conservative where noise is estimated.
        level: Level below which it is an alarm; 0 where something is unknown of the
            noise.
        lower_p_value: Probability of one as small, all parameters taken as determined;
            1 where the size of the noise is not declared.
    """

    log_bayes_factor: float
    threshold: float
    chi_square: float
    degrees_of_freedom: float
    p_value: float
    level: float
    lower_p_value: float = 1.0

    @property
    def alarm(self) -> bool:
        """Whether there is something to trace."""
        return self.by_evidence or self.by_chi_square

    @property
    def by_evidence(self) -> bool:
        """Whether the Bayes factor raises the alarm."""
        return self.log_bayes_factor > self.threshold

    @property
    def by_chi_square(self) -> bool:
        """Whether the chi-square raises the alarm."""
        return self.p_value < self.level


@dataclass(frozen=True, kw_only=True)
class Tracing:
    """Attribution: the effect that the data point to.

    Attributes:
        verdict: "none", "unexplained", "scatter", "outlier", or effects joined by
            " + ".
        chosen: Names of the effects of the verdict; empty for the other four.
        probabilities: Posterior probability by "none", "unexplained", "scatter", after
            an alarm "outlier", effect, and sets of effects that were tried (names
            joined by " + ").
        inclusion: Probability that an effect belongs to the model, by effect.
        credible_set: Smallest set of names with at least 90 % of the probability, most
            probable first.
        equivalent: Groups of names that no permitted action separates ("none" for an
            effect that shows nowhere).
        aliases: After an alarm, pairs of an effect of the verdict and one that explains
            the data about as well (log evidence within log 20 of the best) with
            predictions of the trials closer than the noise; another action, or repeated
            trials, may separate them.
        effects: Effects that were compared, by name.
        evidences: Evidence of every model tried, by name. Priors of effects have
            unknown scale.
        guesses: Formula effects, best first: (formula, log evidence above
            "unexplained"), which is empty unless nothing declared explains the data.
        beside: Effects that explain most of what is "unexplained", the residual process
            taking the rest; empty if it takes all, and for any other verdict.
        outliers: Probability that each trial has a gross error, if one has, by its
            index, most probable first; empty without an alarm.
        needed: Indices of the trials without any one of which the data do not point to
            the effects that explain them best.
        instead_of: Effects that the evidence favors and the verdict does not name,
            since a trial that may have a gross error alone speaks for them, or further
            trials speak against them; "" for none.
        refuted: The RMSE of these further trials, or of left-out ones, before and
            after, which is why; None if it is not.
        refuted_on: Name of these trials; "" for all that had no part in the verdict.
        misfit: Account of the misfit if every model misses by more than the sensor's
            error. Effects that help are then ``chosen``, those that are probably the
            cause are the verdict, and the rest stand in ``beside``.
        stand_in: Reasons why forces of the dictionary that are chosen only stand in for
            something that was not declared, a clause each; empty if they may be it.
        p_value: Tail probability of the chi-square of the verdict's model, its
            parameters all taken as determined; NaN if not requested.
        log_process: Log Bayes factor of a residual process beside that model, nats.
        bounds: Parameters at bounds of the prior, and what a wider one would give.
        set_aside: Trials that every model misses by far more than the others, and that
            had no part in this.
        unproven: Effects that the rule names with the trials among the data that were
            run to test them, and that did not predict these.
    """

    verdict: str
    chosen: tuple[str, ...]
    probabilities: dict[str, float]
    inclusion: dict[str, float]
    credible_set: tuple[str, ...]
    equivalent: tuple[frozenset[str], ...]
    effects: dict[str, Effect]
    evidences: dict[str, Evidence]
    guesses: tuple[tuple[str, float], ...] = ()
    beside: tuple[str, ...] = ()
    outliers: dict[float, float] = field(default_factory=dict)
    needed: tuple[float, ...] = ()
    instead_of: str = ""
    refuted: tuple[float, float] | None = None
    refuted_on: str = ""
    misfit: Misfit | None = None
    stand_in: tuple[str, ...] = ()
    p_value: float = float("nan")
    log_process: float = -float("inf")
    bounds: Bounds = Bounds()
    set_aside: tuple[OutlyingTrial, ...] = ()
    unproven: tuple[str, ...] = ()
    aliases: tuple[frozenset[str], ...] = ()

    @property
    def key(self) -> ModelKey:
        """The model of the verdict, of "unexplained" with the effects beside it."""
        if self.misfit is not None:  # the process is beside every model
            return ModelKey(self.chosen)
        error = self.verdict if self.verdict in CATCH_ALLS else None
        return ModelKey(self.chosen or self.beside, error)

    @property
    def model(self) -> str:
        """Name of the verdict's model in reports."""
        return self.verdict if self.misfit is None else str(self.key)

    @property
    def same(self) -> list[str]:
        """The other names that no permitted action tells from the verdict."""
        own = {*(self.chosen or [self.verdict])}
        groups = [group for group in self.equivalent if group & own]
        return sorted(frozenset().union(*groups) - own)


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Error before and after, on trials used neither to fit nor to choose.

    Attributes:
        scheme: "held out" or "leave one out".
        before: A row a scored trial, with columns "rmse", "energy score", "log
            predictive density", "coverage" (share of entries in the central 90 %),
            "square" (sum of squared errors) and "count" of the numbers.
        after: With the effects added, likewise.
        table: Columns metric, before, after, ratio, interval: RMSE over all scored
            trials, means of the others, ratio after / before (difference for the log
            density and the coverage), and its 90 % bootstrap interval, (low, high),
            paired over trials; None below 8 trials.
        selected: Verdict of each fold, shape (s,).
        names: Names of the scored trials.
        p_value: Tail probability of the chi-square of all scored trials under what the
            model with the effects predicts; NaN where the noise is not declared.
        missed: Held-out trials far outside what that model predicts, farthest first.
    """

    scheme: Literal["held out", "leave one out"]
    before: pd.DataFrame
    after: pd.DataFrame
    table: pd.DataFrame
    selected: tuple[str, ...]
    names: tuple[str, ...]
    p_value: float = float("nan")
    missed: tuple[MissedTrial, ...] = ()

    @property
    def rmse(self) -> tuple[float, float]:
        """Root mean square error before and after, over all scored trials."""
        row = self.table.set_index("metric").loc["rmse"]
        return float(row["before"]), float(row["after"])


@dataclass(frozen=True, kw_only=True)
class NextAction:
    """The action whose outcome tells most about which model is right.

    Attributes:
        action: Action, shape (action_dim,); None if nothing is to be gained.
        candidates: Candidates, shape (a, action_dim).
        information_gain: Lower bound on I(model; x | action) a candidate, nats.
        separates: Names that remain in question.
        inseparable: Groups of them that no permitted action separates.
        outside: An action that is not permitted and separates such a group, shape
            (action_dim,); None if none was found, or none was looked for.
        outside_separates: The group that it separates; empty without.
        outside_gain: Lower bound on the information about which of the group is right,
            all taken as equally likely, nats; 0 without.
    """

    action: Array | None
    candidates: Array
    information_gain: Array
    separates: tuple[str, ...] = field(default_factory=tuple)
    inseparable: tuple[frozenset[str], ...] = ()
    outside: Array | None = None
    outside_separates: tuple[str, ...] = ()
    outside_gain: float = 0.0
