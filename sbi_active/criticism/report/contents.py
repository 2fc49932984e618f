"""Facts of a report, which all that it says is made from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from scipy.stats import spearmanr
from torch.distributions import Distribution

from sbi_active.criticism.contradictions import SevereTest
from sbi_active.criticism.data.columns import split
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.results import (
    NONE,
    OUTLIER,
    UNEXPLAINED,
    Array,
    Detection,
    Evaluation,
    Evidence,
    NextAction,
    Residuals,
    Tracing,
)
from sbi_active.criticism.steps.detection import credible_set
from sbi_active.identifiability.known import Combinations, combinations_of_draws
from sbi_active.seeding import forked_generators
from sbi_active.simulation.model import SimulatorModel

#: Probability with which an outcome lies within the interval of its prediction.
COVERAGE = 0.9


@dataclass(frozen=True, kw_only=True)
class TestedTrial:
    """A trial that was run to test a verdict, and was predicted before.

    Attributes:
        index: Place of the trial in the order of execution.
        action: Action of the trial, shape (action_dim,).
        verdict: Verdict that predicts.
        mean: Predicted numbers, shape (N,), in units of x.
        sd: Their standard deviations, noise included, shape (N,).
        position: Positions of these numbers in the flattened x, shape (N,).
        limit: Distance within which an outcome lies with a probability of .9, root mean
            square over x in ``sd``.
        without: Numbers that the same model predicts without each of its effects, by
            name, named by the verdict or not.
        x: Measured numbers, of the shape of x; none before it was run.
        after: Verdict with the trial among the data.
    """

    index: float
    action: Array
    verdict: str
    mean: Array
    sd: Array
    position: Array
    limit: float
    without: dict[str, Array] = field(default_factory=dict)
    x: Array = field(default_factory=lambda: np.empty(0))
    after: str = ""

    __test__ = False  # no test of pytest's

    @property
    def distance(self) -> float:
        """Distance of the outcome from the prediction, in its standard deviations."""
        return self.off(self.mean, self.sd)

    @property
    def is_measured(self) -> bool:
        """Whether it gave a number that was predicted; else it holds nothing to."""
        return bool(np.isfinite(self.distance))

    @property
    def held(self) -> bool:
        """Whether the outcome lies within the 90 % interval of the prediction."""
        return self.distance <= self.limit

    def in_words(self) -> tuple[str, str]:
        """Return what was predicted and what was measured, in units of x."""
        half = self.limit * float(np.sqrt(np.mean(self.sd**2)))
        predicted = f"within {half:.3g} of its course"
        measured = f"{self.off(self.mean):.3g} off"
        if len(self.mean) == 1:
            predicted = f"{self.mean[0] - half:.4g} to {self.mean[0] + half:.4g}"
            measured = f"{np.ravel(self.x)[self.position][0]:.4g}"
        for name, mean in self.without.items():
            measured += f" (without {name}: {self.off(mean):.3g} off)"
        return predicted, measured if self.is_measured else "nothing"

    def off(self, predicted: Array, unit: Array | float = 1.0) -> float:
        """Return the root mean square by which a prediction missed; NaN for none.

        Args:
            predicted: Numbers that were predicted, shape (N,).
            unit: Unit of each, in that of x.
        """
        error = (np.ravel(self.x)[self.position] - predicted) / unit
        error = error[np.isfinite(error)]
        return float(np.sqrt(np.mean(error**2))) if len(error) else float("nan")


@dataclass(frozen=True, kw_only=True, eq=False)
class Contents:
    """Findings of the closed loop.

    Attributes:
        trials: The measured trials, those left out that were set aside.
        residuals: Residuals of the bare model.
        residuals_after: Residuals of the augmented one; None if nothing was added.
        detection: Whether the bare model misses the data.
        tracing: Tracing with the effect that the data point to.
        evaluation: Error before and after; None if no trial was scored.
        next_action: Action to take next; its ``action`` is None if nothing is to be
            gained. None without permitted actions.
        simulator: The augmented simulator, or the bare one where nothing was added.
        prior: Prior of its parameters (never a posterior).
        digest: Hash of noise, library and priors as they were before the data.
        action_labels: Labels of the entries of the action, with their units.
        severe_tests: Actions that would put a verdict that names effects to the test
            most: a permitted action, and one beyond.
        designed: Actions were chosen for their information.
        exploratory: Library or priors were changed after the data were seen.
        notes: What the comparison left out, a code and a sentence each.
        tested: Trials that were run to test the verdict, in order.
        stopped: Reason to run no more of them.
    """

    trials: Trials
    residuals: Residuals
    detection: Detection
    tracing: Tracing
    simulator: SimulatorModel
    prior: Distribution
    action_labels: Sequence[str]
    residuals_after: Residuals | None = None
    evaluation: Evaluation | None = None
    next_action: NextAction | None = None
    severe_tests: tuple[SevereTest, ...] = ()
    digest: str = ""
    designed: bool = False
    exploratory: bool = False
    notes: tuple[str, ...] = ()
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
        own = [trial for trial in self.measured if name in trial.without]
        without = [trial.off(trial.without[name], trial.sd) for trial in own]
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
        columns = ["metric", "before", "after", "ratio", "interval"]
        scored = self.evaluation
        return pd.DataFrame(columns=columns) if scored is None else scored.table

    @property
    def evidence(self) -> Evidence:
        """The model of the verdict, or the bare one where it has no draws."""
        evidences = self.tracing.evidences
        return evidences.get(self.tracing.model, evidences[NONE])

    @property
    def parameters(self) -> pd.DataFrame:
        """Columns parameter, before, before_sd, after, after_sd; phi has no before.

        Values are means and deviations of posteriors. A model that misses the trials
        has its best fit, with a deviation that includes the misfit.
        """
        before, after = self.tracing.evidences[NONE].moments, self.evidence.moments
        rows = [(n, *before.get(n, (np.nan,) * 2), *after[n]) for n in after]
        columns = ["parameter", "before", "before_sd", "after", "after_sd"]
        return pd.DataFrame(rows, columns=columns)

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
        times = np.nan if found.times is None else found.times
        times, channels = np.broadcast_to(times, z.shape[:2]), self.channels(z.shape[2])
        rows = []
        for t in np.flatnonzero(np.isfinite(z).any((1, 2))):
            k, c = np.unravel_index(np.nanargmax(np.abs(z[t])), z[t].shape)
            row = {"trial": found.names[t], "index": float(found.index[t])}
            row["deviations"] = float(root_mean_square(z[t]))
            row["size"] = float(root_mean_square(left[t, :, c]))
            rows.append(row | {"channel": channels[int(c)], "time": float(times[t, k])})
        table = pd.DataFrame(rows)
        return table.sort_values("deviations", ascending=False, kind="stable")

    @property
    def worst(self) -> list[Any]:
        """Rows of that table as dictionaries, without columns that are not known."""
        known = self.residuals_by_trial.dropna(axis="columns", how="all")
        return known.to_dict("records")

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
    def left(self) -> tuple[Array, Array | None, float]:
        """Root mean square of what the verdict's model leaves.

        In units of x and in deviations of the sensor, by channel, the latter None where
        they are not declared; in those of the prediction.
        """
        found = self.residuals_after or self.residuals
        kept = self._agreeing(found.names)
        in_predictions = root_mean_square(found.refitted[kept])
        left = by_channel(found.x - found.mean, found)[kept]
        own, sensor = root_mean_square(left, (0, 1)), self.sensor
        if sensor is None or sensor.shape not in ((1,), own.shape):
            return own, None, float(in_predictions)
        own = own if len(sensor) > 1 else root_mean_square(left)[None]
        return own, own / sensor, float(in_predictions)

    @property
    def rmse_of_others(self) -> tuple[float, float]:
        """RMSE before and after of scored trials without a gross error; NaN of none."""
        if self.evaluation is None:
            return np.nan, np.nan
        kept = self._agreeing(self.evaluation.names)
        scores = self.evaluation.before, self.evaluation.after
        each = [s.loc[kept, ["square", "count"]].sum().to_numpy() for s in scores]
        before, after = (float(np.sqrt(square / count)) for square, count in each)
        return before, after

    def _agreeing(self, names: Sequence[str]) -> NDArray[np.bool_]:
        """Return a mask of trials by name: all but those of an outlier, shape (t,)."""
        wrong = credible_set(self.tracing.outliers) if self.verdict == OUTLIER else ()
        return ~np.isin(names, self.called(wrong))

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
        prior, evidence = self.prior_draws("report"), self.evidence
        dim = prior.shape[1]
        draws = evidence.draws[:, :dim]  # beyond these there may be those of errors
        if draws.shape[1] < dim:
            return Combinations()
        return combinations_of_draws(draws, prior, evidence.names[:dim])

    def prior_draws(self, stream: str) -> Array:
        """Return draws of the prior, shape (m, dim), the same for a stream."""
        with forked_generators(0, stream):
            return self.prior.sample(torch.Size([2_000])).double().numpy()

    def called(self, indices: Iterable[float]) -> list[str]:
        """Return the names of fitted trials by their indices."""
        fit = self.trials.fit
        names = dict(zip(fit.index.tolist(), fit.names, strict=True))
        return [names[index] for index in indices]

    @property
    def channel_names(self) -> Sequence[str] | None:
        """Labels of the entries of x's last axis, where known."""
        return self.trials.channel_labels or self.simulator.channel_names

    def channels(self, num: int) -> Sequence[str]:
        """Return the labels of a number of channels."""
        names = self.channel_names or ()
        return names if len(names) == num else [f"channel {c}" for c in range(num)]

    def setting(self, action: Array) -> str:
        """Return an action in words, as in "speed = 2.5 m/s", or its trial's name."""
        if self.trials.action_is_label:
            numbers = self.trials.action[:, 0].tolist()
            names = dict(zip(numbers, self.trials.names, strict=True))
            name = names.get(float(action[0]), f"{action[0]:g}")
            return f"the inputs of trial {name}"
        pairs = zip(map(split, self.action_labels), action, strict=True)
        said = [f"{name} = {value:.4g} {unit}" for (name, unit), value in pairs]
        return ", ".join(map(str.rstrip, said))


def by_channel(x: Array, residuals: Residuals) -> Array:
    """Return trials, times and channels, (t, k, c); each number is one without time."""
    return x.reshape(len(x), 1 if residuals.times is None else x.shape[1], -1)


def root_mean_square(x: Array, axis: int | tuple[int, ...] | None = None) -> Array:
    """Return the root mean square of the numbers that were measured."""
    seen = np.isfinite(x)
    total = np.where(seen, x, 0.0) ** 2
    return np.sqrt(total.sum(axis) / np.maximum(seen.sum(axis), 1))
