"""The report of a closed loop: verdict, evidence, and the error before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import pandas as pd
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.report import rendering
from sbi_active.criticism.report.cautions import find_warnings
from sbi_active.criticism.report.headline import verdict_line
from sbi_active.criticism.results import (
    NONE,
    UNEXPLAINED,
    Detection,
    Evaluation,
    NextAction,
    Residuals,
    SevereTest,
    Tracing,
)
from sbi_active.criticism.steps.leave_one_out import LeaveOneOut
from sbi_active.simulation import SimulatorModel

__all__ = ["Report", "build_report"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Report:
    """What the closed loop found.

    ``print(report)`` has the verdict in its first line.

    Attributes:
        residuals: Of the bare model.
        residuals_after: Of the augmented one; None where nothing was added.
        detection: Whether the bare model misses the data.
        tracing: Which effect the data point to.
        evaluation: Error before and after; None where no trial was scored.
        next_action: What to do next; its ``action`` is None where nothing is to be
            gained. None without permitted actions.
        simulator: The augmented simulator, or the bare one where nothing was added.
        prior: Of its parameters (never a posterior).
        warnings: One sentence each.
        digest: Hash of noise, library and priors as they were before the data.
        exploratory: Library or priors were changed after the data were seen.
        num_trials: Trials that could be fitted.
        action_labels: One an entry of the action, with its unit.
        channel_names: One an entry of x's last axis, where known.
        leave_one_out: Of the bare model and of the one that was chosen, where trials
            are independent given their parameters.
        severe_tests: Where a verdict that names effects would be put to the test most:
            a permitted action, and one beyond.
    """

    residuals: Residuals
    residuals_after: Residuals | None
    detection: Detection
    tracing: Tracing
    evaluation: Evaluation | None
    next_action: NextAction | None
    simulator: SimulatorModel
    prior: Distribution
    warnings: tuple[str, ...]
    digest: str
    exploratory: bool
    num_trials: int
    action_labels: tuple[str, ...]
    channel_names: tuple[str, ...] | None
    leave_one_out: tuple[LeaveOneOut, ...] = ()
    severe_tests: tuple[SevereTest, ...] = ()

    def __str__(self) -> str:
        return rendering.to_text(self)

    def __repr__(self) -> str:
        return f"Report({verdict_line(self)!r})"

    def __reduce__(self) -> tuple[Any, ...]:
        # Effects are lambdas and local functions as a rule, which pickle refuses.
        parts = {f.name: getattr(self, f.name) for f in fields(self)}
        return _restored, (cloudpickle.dumps(parts),)

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
        """A formula that explains what no declared effect does: not declared."""
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
        """Columns parameter, before, before_sd, after, after_sd; phi has no before."""
        evidences = self.tracing.evidences
        before, after = evidences[NONE], evidences.get(self.verdict)
        rows = {
            name: [*_moments(before.draws[:, i]), np.nan, np.nan]
            for i, name in enumerate(before.names)
        }
        if after is not None and self.verdict != NONE:
            for i, name in enumerate(after.names):
                row = rows.setdefault(name, [np.nan] * 4)
                row[2:] = _moments(after.draws[:, i])
        names = ["before", "before_sd", "after", "after_sd"]
        table = pd.DataFrame.from_dict(rows, orient="index", columns=pd.Index(names))
        return table.rename_axis("parameter").reset_index()

    def to_markdown(self) -> str:
        """Return the report as Markdown, figures by the names that ``save`` gives."""
        return rendering.to_markdown(self)

    def to_html(self) -> str:
        """Return the report as one self-contained page with its figures."""
        return rendering.to_html(self)

    def save(self, directory: str | Path) -> Path:
        """Write report.txt, report.md, report.html and the figures as PNG.

        Args:
            directory: Made where it does not exist.

        Returns:
            The page's path.
        """
        directory = Path(directory)
        directory.mkdir(parents=True, exist_ok=True)
        (directory / "report.txt").write_text(f"{self}\n", encoding="utf-8")
        (directory / "report.md").write_text(self.to_markdown(), encoding="utf-8")
        page = directory / "report.html"
        page.write_text(self.to_html(), encoding="utf-8")
        for name, figure in rendering.figures(self).items():
            figure.savefig(directory / f"{name}.png", dpi=150)
        return page


def build_report(
    *,
    trials: Trials,
    residuals: Residuals,
    detection: Detection,
    tracing: Tracing,
    simulator: SimulatorModel,
    prior: Distribution,
    residuals_after: Residuals | None = None,
    evaluation: Evaluation | None = None,
    next_action: NextAction | None = None,
    actions: ActionSpace | None = None,
    digest: str = "",
    exploratory: bool = False,
    designed: bool = False,
    leave_one_out: Sequence[LeaveOneOut] = (),
    severe_tests: Sequence[SevereTest] = (),
    warnings: Sequence[str] = (),
) -> Report:
    """Put the parts together, and find what a reader must be warned of.

    Args:
        trials: The measured trials.
        residuals: Of the bare model.
        detection: Whether it misses the data.
        tracing: Which effect the data point to.
        simulator: The augmented simulator, or the bare one.
        prior: Of its parameters.
        residuals_after: Of the augmented simulator.
        evaluation: Error before and after.
        next_action: What to do next.
        actions: Permitted ones, for names and units.
        digest: Hash of what was frozen before the data.
        exploratory: What was frozen was changed afterwards.
        designed: Actions were chosen for their information.
        leave_one_out: Of the bare model and of the one that was chosen.
        severe_tests: Where the verdict would be put to the test most.
        warnings: Further ones.

    Returns:
        The report.
    """
    labels = [f"action {i + 1}" for i in range(trials.action.shape[1])]
    if trials.action_labels is not None:
        labels = trials.action_labels
    elif actions is not None:
        pairs = zip(actions.names, actions.units, strict=True)
        labels = [f"{name} [{unit}]" if unit else name for name, unit in pairs]
    found = find_warnings(
        trials,
        residuals,
        tracing,
        detection=detection,
        residuals_after=residuals_after,
        evaluation=evaluation,
        effects=getattr(prior, "effects", ()),
        exploratory=exploratory,
        designed=designed,
    )
    channels = trials.channel_labels or simulator.channel_names
    return Report(
        residuals=residuals,
        residuals_after=residuals_after,
        detection=detection,
        tracing=tracing,
        evaluation=evaluation,
        next_action=next_action,
        simulator=simulator,
        prior=prior,
        warnings=(*found, *warnings),
        digest=digest,
        exploratory=exploratory,
        num_trials=len(trials.fit),
        action_labels=tuple(labels),
        channel_names=None if channels is None else tuple(channels),
        leave_one_out=tuple(leave_one_out),
        severe_tests=tuple(severe_tests),
    )


def _restored(parts: bytes) -> Report:
    return Report(**cloudpickle.loads(parts))


def _moments(draws: np.ndarray) -> list[float]:
    return [float(draws.mean()), float(draws.std())]
