"""Contents of a report, apart from its layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
import torch
from scipy.stats import spearmanr
from torch.distributions import Distribution

from sbi_active.criticism.contradictions import SevereTest
from sbi_active.criticism.data.columns import split
from sbi_active.criticism.results import (
    NONE,
    UNEXPLAINED,
    Array,
    Detection,
    Evaluation,
    Evidence,
    NextAction,
    Residuals,
    Tracing,
)
from sbi_active.identifiability.known import (
    Combinations,
    combinations_of_draws,
)
from sbi_active.seeding import forked_generators
from sbi_active.simulation.model import SimulatorModel


@dataclass(frozen=True, kw_only=True)
class Registered:
    """What a verdict predicts of a trial, written down before the trial is run.

    Attributes:
        index: Place of the trial in the order of execution.
        action: Action of the trial, shape (action_dim,).
        purpose: What the trial is to tell.
        verdict: Verdict that predicts.
        mean: Predicted numbers, shape (N,), in units of x.
        sd: Their standard deviations, noise included, shape (N,).
        position: Positions of these numbers in the flattened x, shape (N,).
        limit: Distance within which an outcome lies with a probability of .9, root mean
            square over x in ``sd``.
        without: Numbers that the same model predicts without each of its effects, by
            name, named by the verdict or not.
    """

    index: float
    action: Array
    purpose: str
    verdict: str
    mean: Array
    sd: Array
    position: Array
    limit: float
    without: dict[str, Array] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class TestedTrial:
    """A trial that was run to test a verdict.

    Attributes:
        registered: Prediction, made before the trial was run.
        x: Measured numbers, of the shape of x.
        after: Verdict with the trial among the data.
    """

    registered: Registered
    x: Array
    after: str = ""

    __test__ = False  # no test of pytest's

    @property
    def distance(self) -> float:
        """Distance of the outcome from the prediction, in its standard deviations."""
        return self.off(self.registered.mean, self.registered.sd)

    @property
    def is_measured(self) -> bool:
        """Whether it gave a number that was predicted; else it holds nothing to."""
        return bool(np.isfinite(self.distance))

    @property
    def held(self) -> bool:
        """Whether the outcome lies within the 90 % interval of the prediction."""
        return self.distance <= self.registered.limit

    def in_words(self) -> tuple[str, str]:
        """Return what was predicted and what was measured, in units of x."""
        own, is_one = self.registered, len(self.registered.mean) == 1
        half = own.limit * float(np.sqrt(np.mean(own.sd**2)))
        predicted = f"within {half:.3g} of its course"
        if is_one:
            predicted = f"{own.mean[0] - half:.4g} to {own.mean[0] + half:.4g}"
        if not self.is_measured:
            return predicted, "nothing"
        measured = f"{self.off(own.mean):.3g} off"
        if is_one:
            measured = f"{np.ravel(self.x)[own.position][0]:.4g}"
        for name, mean in own.without.items():
            measured += f" (without {name}: {self.off(mean):.3g} off)"
        return predicted, measured

    def off(self, predicted: Array, unit: Array | float = 1.0) -> float:
        """Return the root mean square by which a prediction missed; NaN for none.

        Args:
            predicted: Numbers that were predicted, shape (N,).
            unit: Unit of each, in that of x.
        """
        error = (np.ravel(self.x)[self.registered.position] - predicted) / unit
        error = error[np.isfinite(error)]
        return float(np.sqrt(np.mean(error**2))) if len(error) else float("nan")


@dataclass(frozen=True, kw_only=True, eq=False)
class Contents:
    """Findings of the closed loop.

    Attributes:
        residuals: Residuals of the bare model.
        residuals_after: Residuals of the augmented one; None if nothing was added.
        detection: Whether the bare model misses the data.
        tracing: Tracing with the effect that the data point to.
        evaluation: Error before and after; None if no trial was scored.
        next_action: Action to take next; its ``action`` is None if nothing is to be
            gained. None without permitted actions.
        simulator: The augmented simulator, or the bare one where nothing was added.
        prior: Prior of its parameters (never a posterior).
        warnings: Warnings, one sentence each.
        num_simulations: Trials simulated for all of it.
        digest: Hash of noise, library and priors as they were before the data.
        exploratory: Library or priors were changed after the data were seen.
        num_trials: Trials that could be fitted.
        action_labels: Labels of the entries of the action, with their units.
        channel_names: Names of the entries of x's last axis, where known.
        severe_tests: Actions that would put a verdict that names effects to the test
            most: a permitted action, and one beyond.
        action_is_label: Whether the action is only the trial's number.
        tested: Trials that were run to test the verdict, in order.
        stopped: Reason to run no more of them.
    """

    residuals: Residuals
    detection: Detection
    tracing: Tracing
    simulator: SimulatorModel
    prior: Distribution
    warnings: tuple[str, ...]
    exploratory: bool
    num_trials: int
    action_labels: tuple[str, ...]
    channel_names: tuple[str, ...] | None
    residuals_after: Residuals | None = None
    evaluation: Evaluation | None = None
    next_action: NextAction | None = None
    digest: str = ""
    num_simulations: int = 0
    severe_tests: tuple[SevereTest, ...] = ()
    action_is_label: bool = False
    tested: tuple[TestedTrial, ...] = ()
    stopped: str = ""

    @property
    def verdict(self) -> str:
        """A catch-all ("none", "unexplained", ...) or effects joined by " + "."""
        return self.tracing.verdict

    @property
    def probabilities(self) -> dict[str, float]:
        """Posterior probability by effect and catch-all, "outlier" after an alarm."""
        return self.tracing.probabilities

    @property
    def has_probabilities(self) -> bool:
        """Whether probabilities by the fitted trials alone agree with the verdict.

        They do not where every model misses, or other trials speak against the most
        probable one.
        """
        return self.tracing.misfit is None and not self.tracing.instead_of

    @property
    def credible_set(self) -> tuple[str, ...]:
        """Smallest set of names that holds 90 % of the probability."""
        return self.tracing.credible_set

    @property
    def equivalent(self) -> tuple[frozenset[str], ...]:
        """Groups of names that no permitted action separates."""
        return self.tracing.equivalent

    @property
    def measured(self) -> list[TestedTrial]:
        """Tested trials that gave a number that was predicted, in order."""
        return [trial for trial in self.tested if trial.is_measured]

    def left_by(self, name: str) -> float:
        """Return the share of the squared error that an effect left of predictions.

        That of models that had it, by that of the same models without it, in their
        standard deviations; NaN if no trial tested it, infinite if the latter is 0.

        Args:
            name: Name of the effect.
        """
        own = [t for t in self.measured if name in t.registered.without]
        without = [t.off(t.registered.without[name], t.registered.sd) for t in own]
        if not any(without):
            return np.inf if own else np.nan
        return sum(t.distance**2 for t in own) / sum(d**2 for d in without)

    @property
    def guess(self) -> str | None:
        """A formula, not declared, that explains what no declared effect does."""
        if self.verdict != UNEXPLAINED or not self.tracing.guesses:
            return None
        return self.tracing.guesses[0][0]

    @property
    def before_after(self) -> pd.DataFrame:
        """Columns metric, before, after, ratio, interval (90 %, (low, high) or None).

        The ratio of "log predictive density" and "coverage" is their difference.
        """
        columns = pd.Index(["metric", "before", "after", "ratio", "interval"])
        if self.evaluation is None:
            return pd.DataFrame(columns=columns)
        table = self.evaluation.table
        ends = zip(table["low"], table["high"], strict=True)
        interval = [
            (float(a), float(b)) if np.isfinite(a + b) else None for a, b in ends
        ]
        table = table.assign(interval=pd.Series(interval, dtype=object))
        return table.reindex(columns=columns)

    @property
    def rmse(self) -> tuple[float, float]:
        """Root mean square error before and after, where trials were scored."""
        assert self.evaluation is not None
        return self.evaluation.rmse

    @property
    def parameters(self) -> pd.DataFrame:
        """Columns parameter, before, before_sd, after, after_sd; phi has no before.

        Values are means and deviations of posteriors. A model that misses the trials
        has its best fit, with a deviation that includes the misfit.
        """
        bare = self.tracing.evidences[NONE]
        after = self.tracing.evidences.get(self.tracing.model, bare)
        parts = [_moments(bare, "before")]
        parts += [] if after is bare else [_moments(after, "after")]
        table = pd.concat(parts, axis=1).rename_axis("parameter")
        columns = ["before", "before_sd", "after", "after_sd"]
        return table.reindex(columns=pd.Index(columns)).reset_index()

    @property
    def residuals_by_trial(self) -> pd.DataFrame:
        """Residuals of the verdict's model, one row a trial, the worst first.

        Columns trial, index (its place in the order of execution), deviations (root
        mean square, in deviations of the sensor where every model misses, else of the
        prediction), size (in the unit of x, of the channel of the largest), channel and
        time of the largest.
        """
        found = self.residuals_after or self.residuals
        left = by_channel(found.x - found.mean, found)
        z = by_channel(found.refitted, found)
        if self.tracing.misfit is not None:  # a prediction is as wide as the misfit
            z = left / self.tracing.misfit.sensor
        times = found.times
        if times is not None:
            times = np.broadcast_to(times, left.shape[:2])
        rows = []
        for t in np.flatnonzero(np.isfinite(z).any((1, 2))):
            k, c = np.unravel_index(np.nanargmax(np.abs(z[t])), z[t].shape)
            when = np.nan if times is None else float(times[t, k])
            size = float(root_mean_square(left[t, :, c]))
            deviations = float(root_mean_square(z[t]))
            name = found.called(int(t))
            rows.append((name, float(found.index[t]), deviations, size, int(c), when))
        columns = ["trial", "index", "deviations", "size", "channel", "time"]
        table = pd.DataFrame(rows, columns=pd.Index(columns))
        return table.sort_values("deviations", ascending=False, kind="stable")

    @property
    def growth(self) -> float | None:
        """Ratio of residuals of the last third of trials to the first's, if they grow.

        None where their rank correlation with the order has a tail probability of .01
        or more, or where they grow by less than twice: a right model is then called
        growing in less than 1 % of sets.
        """
        table = self.residuals_by_trial.sort_values("index")
        third = len(table) // 3
        if third < 2 or self.verdict == NONE:
            return None
        size = table["deviations"].to_numpy()
        rank: Any = spearmanr(table["index"], size, alternative="greater")
        first, last = np.median(size[:third]), np.median(size[-third:])
        grows = rank.pvalue < 0.01 and last > 2 * first > 0
        return float(last / first) if grows else None

    @property
    def sensor(self) -> Array | None:
        """The sensor's declared error by channel, shape (c,); None without."""
        if self.tracing.misfit is not None:
            return self.tracing.misfit.sensor
        declared = getattr(self.simulator.noise, "measurement_sd", None)
        return None if declared is None else np.reshape(np.asarray(declared, float), -1)

    @property
    def combinations(self) -> Combinations:
        """Combinations of parameters that the verdict's model knows, and does not."""
        evidences = self.tracing.evidences
        evidence = evidences.get(self.tracing.model, evidences[NONE])
        prior = self.prior_draws("report")
        dim = prior.shape[1]
        draws = evidence.draws[:, :dim]  # beyond these there may be those of errors
        if draws.shape[1] < dim:
            return Combinations()
        return combinations_of_draws(draws, prior, evidence.names[:dim])

    def prior_draws(self, stream: str) -> Array:
        """Return draws of the prior, shape (m, dim), the same for a stream."""
        with forked_generators(0, stream):
            return self.prior.sample(torch.Size([2_000])).double().numpy()

    @property
    def tests(self) -> list[str]:
        """Actions of the severe tests, in words."""
        return [
            f"{'at' if test.is_permitted else 'beyond the permitted range at'} "
            f"{self.setting(test.action)}"
            for test in self.severe_tests
        ]

    def channels(self, num: int) -> list[tuple[str, str]]:
        """Return name and unit of each of some channels."""
        labels: Sequence[str] = self.channel_names or ()
        if len(labels) != num:
            labels = [f"channel {c}" for c in range(num)]
        return [*map(split, labels)]

    def setting(self, action: Array) -> str:
        """Return an action in words: a label is the name of its trial."""
        if not self.action_is_label:
            return setting(self.action_labels, action)
        own = np.flatnonzero((self.residuals.action == action).all(1))
        names = self.residuals.names
        name = names[own[0]] if len(own) and names else f"{action[0]:g}"
        return f"the inputs of trial {name}"


def by_channel(x: Array, residuals: Residuals) -> Array:
    """Return trials, times and channels, (t, k, c); each number is one without time."""
    return x.reshape(len(x), 1 if residuals.times is None else x.shape[1], -1)


def root_mean_square(x: Array, axis: int | tuple[int, ...] | None = None) -> Array:
    """Return the root mean square of the numbers that were measured."""
    seen = np.isfinite(x)
    total = np.where(seen, x, 0.0) ** 2
    return np.sqrt(total.sum(axis) / np.maximum(seen.sum(axis), 1))


def _moments(evidence: Evidence, when: str) -> pd.DataFrame:
    """Return mean and deviation of each parameter in a model.

    Draws of one that misses the trials are within the prior: their mean is no fit.
    """
    num = len(evidence.names)
    draws, best = evidence.draws[:, :num], evidence.best
    center = draws.mean(0) if best is None else best[:num]
    values = {when: center, f"{when}_sd": draws.std(0)}
    return pd.DataFrame(values, index=[*evidence.names])


def setting(labels: Sequence[str], action: Array) -> str:
    """Return an action in words, each entry with its name and unit.

    Example:
        >>> setting(["speed [m/s]", "tilt"], np.array([2.5, 0.125]))
        'speed = 2.5 m/s, tilt = 0.125'
    """
    return ", ".join(
        f"{name} = {value:.4g} {unit}".rstrip()
        for (name, unit), value in zip(map(split, labels), action, strict=True)
    )
