"""Contents of a report, apart from its layout."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from torch.distributions import Distribution

from sbi_active.criticism.contradictions import SevereTest
from sbi_active.criticism.results import (
    NONE,
    UNEXPLAINED,
    Detection,
    Evaluation,
    Evidence,
    NextAction,
    Residuals,
    Tracing,
)
from sbi_active.criticism.steps.leave_one_out import LeaveOneOut
from sbi_active.inference.beliefs.identifiability import (
    Combinations,
    combinations_of_draws,
)
from sbi_active.seeding import forked_generators
from sbi_active.simulation.model import SimulatorModel

NUM_PRIOR = 2_000  # draws that a width is compared with


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
        digest: Hash of noise, library and priors as they were before the data.
        exploratory: Library or priors were changed after the data were seen.
        num_trials: Trials that could be fitted.
        action_labels: Labels of the entries of the action, with their units.
        channel_names: Names of the entries of x's last axis, where known.
        leave_one_out: Leave-one-out scores of the bare model and of the one that was
            chosen, where trials are independent given their parameters.
        severe_tests: Actions that would put a verdict that names effects to the test
            most: a permitted action, and one beyond.
        action_is_label: Whether the action is only the trial's number.
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
    leave_one_out: tuple[LeaveOneOut, ...] = ()
    severe_tests: tuple[SevereTest, ...] = ()
    action_is_label: bool = False

    @property
    def verdict(self) -> str:
        """A catch-all ("none", "unexplained", ...) or effects joined by " + "."""
        return self.tracing.verdict

    @property
    def probabilities(self) -> dict[str, float]:
        """Posterior probability by effect and catch-all, "outlier" after an alarm."""
        return self.tracing.probabilities

    @property
    def credible_set(self) -> tuple[str, ...]:
        """Smallest set of names that holds 90 % of the probability."""
        return self.tracing.credible_set

    @property
    def equivalent(self) -> tuple[frozenset[str], ...]:
        """Groups of names that no permitted action separates."""
        return self.tracing.equivalent

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
        if self.evaluation is None:
            return pd.DataFrame(columns=pd.Index(columns))
        table = self.evaluation.table
        ends = zip(table["low"], table["high"], strict=True)
        interval = [
            (float(low), float(high)) if np.isfinite([low, high]).all() else None
            for low, high in ends
        ]
        table = table.assign(interval=pd.Series(interval, dtype=object))
        return table.loc[:, columns]

    @property
    def parameters(self) -> pd.DataFrame:
        """Columns parameter, before, before_sd, after, after_sd; phi has no before.

        Values are means and deviations of posteriors. A model that misses the trials
        has its best fit, with a deviation that includes the misfit.
        """
        evidences = self.tracing.evidences
        before, after = evidences[NONE], evidences.get(self.tracing.model)
        rows = {
            name: [*_moments(before, i), np.nan, np.nan]
            for i, name in enumerate(before.names)
        }
        if after is not None and self.tracing.model != NONE:
            for i, name in enumerate(after.names):
                row = rows.setdefault(name, [np.nan] * 4)
                row[2:] = _moments(after, i)
        names = ["before", "before_sd", "after", "after_sd"]
        table = pd.DataFrame.from_dict(rows, orient="index", columns=pd.Index(names))
        return table.rename_axis("parameter").reset_index()

    @property
    def combinations(self) -> Combinations:
        """Combinations of parameters that the verdict's model knows, and does not."""
        evidences = self.tracing.evidences
        evidence = evidences.get(self.tracing.model, evidences[NONE])
        with forked_generators(0, "report"):
            prior = self.prior.sample(torch.Size([NUM_PRIOR])).double().numpy()
        dim = prior.shape[1]
        draws = evidence.draws[:, :dim]  # beyond these there may be those of errors
        if draws.shape[1] < dim:
            return Combinations()
        return combinations_of_draws(draws, prior, evidence.names[:dim])


def _moments(evidence: Evidence, i: int) -> list[float]:
    """Return a parameter's mean and deviation in a model.

    Of one that misses the trials draws are spread by the misfit, and moved within the
    prior: their mean is no fit.
    """
    draws, center = evidence.draws[:, i], evidence.draws[:, i].mean()
    if evidence.best is not None:
        center = evidence.best[i]
    elif evidence.narrow is not None:
        center = evidence.narrow[:, i].mean()
    return [float(center), float(draws.std())]
