"""Figures of a report: residuals, and the error before and after."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sbi_active.criticism.report.contents import Contents
from sbi_active.criticism.report.words import added
from sbi_active.criticism.results import Array, Evaluation, Residuals

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BEFORE, AFTER, FAINT = "#c1432e", "#2f6f9f", "#9aa3ab"
METRICS = {
    "rmse": "RMSE",
    "energy score": "energy score",
    "log predictive density": "log predictive density [nats]",
    "coverage": "share inside the central 90 %",
}
CAPTIONS = {
    "residuals": "Residuals of the models refitted to all trials, in standard "
    "deviations of the prediction; the band is two of them. Each row has its scale, "
    "logarithmic beyond the band where residuals are large.",
    "before_after": "One line a scored trial; the bars are over all of them. Lower is "
    "better for the first two, higher for the third; the dotted line is 90 %.",
}


def figures(report: Contents) -> dict[str, Figure]:
    """Return the report's figures by name."""
    found = {
        "residuals": plot_residuals(
            report.residuals,
            report.residuals_after,
            action_labels=() if report.action_is_label else report.action_labels,
            channel_names=report.channel_names,
            added=added(report),
        ),
    }
    if report.evaluation is not None:
        found["before_after"] = plot_before_after(report.evaluation)
    return found


def plot_residuals(
    before: Residuals,
    after: Residuals | None = None,
    *,
    action_labels: Sequence[str] = (),
    channel_names: Sequence[str] | None = None,
    added: str = "the effect",
) -> Figure:
    """Draw standardized residuals by action, trial, and channel or time.

    Each model is refitted to all trials that may be fitted. The band is two standard
    deviations of the predictive.

    Args:
        before: Residuals of the bare model, the upper row.
        after: Residuals of the augmented one, the lower row; None if nothing was
            added.
        action_labels: Labels of the entries of the action, with their units; none where
            the action is only the trial's number.
        channel_names: Names of the entries of x without a time axis.
        added: Name of what the augmented model adds.

    Returns:
        The figure.
    """
    rows = [(before, "bare model", BEFORE)]
    if after is not None:
        rows.append((after, f"with {added}", AFTER))
    shown = min(len(action_labels), 3)
    several = before.x[0].size > 1
    columns = shown + 1 + several
    figure, axes = _subplots(len(rows), columns, width=3.3, height=2.5)
    for line, (residuals, title, color) in zip(axes, rows, strict=True):
        each = residuals.refitted.reshape(len(residuals.index), -1)
        for i in range(shown):
            _scatter(line[i], residuals.action[:, i], each, color)
            line[i].set_xlabel(action_labels[i])
        _scatter(line[shown], residuals.index, each, color)
        _trial_axis(line[shown], residuals)
        if several:
            _by_entry(line[-1], residuals, color, channel_names)
        for ax in line:
            _residual_axis(ax, each)
        line[0].set_ylabel(f"{title}\nresidual [sd]", color=color)
    return figure


def plot_before_after(evaluation: Evaluation) -> Figure:
    """Draw every score of every scored trial before and after, paired.

    Args:
        evaluation: Scores on trials used neither to fit nor to choose.

    Returns:
        The figure.
    """
    metrics = [name for name in METRICS if name in evaluation.before]
    figure, axes = _subplots(1, len(metrics), width=2.5, height=2.7)
    for ax, name in zip(axes[0], metrics, strict=True):
        pairs = np.stack([evaluation.before[name], evaluation.after[name]])
        ax.plot([0, 1], pairs, color=FAINT, lw=0.8, alpha=0.7, zorder=1)
        total = evaluation.table[evaluation.table["metric"] == name]
        for x, (when, color) in enumerate((("before", BEFORE), ("after", AFTER))):
            places = np.full(pairs.shape[1], x)
            ax.plot(places, pairs[x], ".", ms=5, color=color, alpha=0.6)
            ax.plot([x] * len(total), total[when], "k_", ms=22, mew=2, zorder=3)
        if name in ("rmse", "energy score"):
            positive = pairs[np.isfinite(pairs) & (pairs > 0)]
            is_wide = positive.size and positive.max() > 10 * positive.min()
            ax.set(yscale="log") if is_wide else ax.set_ylim(bottom=0)
        if name == "log predictive density" and np.nanmin(pairs) < -200:
            ax.set_yscale("symlog", linthresh=10)
        if name == "coverage":
            ax.axhline(0.9, color="#333333", lw=0.8, ls=":")
            ax.set_ylim(-0.04, 1.04)
        ax.set(xlim=(-0.5, 1.5), xticks=[0, 1], xticklabels=["before", "after"])
        ax.set_title(METRICS[name], fontsize=9)
        _plain(ax)
    return figure


def _by_entry(
    ax: Axes, residuals: Residuals, color: str, channel_names: Sequence[str] | None
) -> None:
    """Draw one line a trial over time, or points over the channels."""
    each = residuals.refitted.reshape(len(residuals.index), -1)
    if residuals.times is not None:
        length = residuals.x.shape[1]
        times = np.broadcast_to(residuals.times, (len(each), length))
        for time, z in zip(times, residuals.refitted, strict=True):
            for channel in z.reshape(length, -1).T:
                seen = np.isfinite(channel)  # through samples that are not used
                ax.plot(time[seen], channel[seen], color=color, lw=0.8, alpha=0.6)
        ax.set_xlabel("time [s]")
        return
    num = each.shape[1]
    ax.plot(np.arange(num), each.T, ".", ms=4, alpha=0.6, c=color)
    ax.set_xlabel("channel")
    if channel_names is not None and len(channel_names) == num <= 12:
        ax.set_xticks(range(num), channel_names, rotation=45, ha="right", fontsize=7)
        ax.set_xlabel("")


def _scatter(ax: Axes, place: Array, each: Array, color: str) -> None:
    """Draw all entries of a trial at its place."""
    many = each.shape[1] > 1
    ax.plot(place, each, ".", ms=3 if many else 7, alpha=0.45 if many else 0.9, c=color)


def _trial_axis(ax: Axes, residuals: Residuals) -> None:
    """Name the trials, or number them where they are many or have no names."""
    index, names = residuals.index, residuals.names
    ax.set_xlabel("trial")
    numbered = all(n == f"{i:.15g}" for n, i in zip(names, index, strict=False))
    if numbered or len(names) > 16:
        locator: Any = ax.xaxis.get_major_locator()
        locator.set_params(integer=True)
        return
    ax.set_xticks(index, names, rotation=45, ha="right", fontsize=7)


def _residual_axis(ax: Axes, each: Array) -> None:
    ax.axhspan(-2, 2, color="#e9edf0", zorder=0)
    ax.axhline(0, color="#555555", lw=0.8, zorder=0)
    finite = each[np.isfinite(each)]
    largest = max(float(np.abs(finite).max(initial=0.0)) * 1.15, 3.5)
    if largest > 12.0:
        largest *= 1.4
        ax.set_yscale("symlog", linthresh=2)
    ax.set_ylim(-largest, largest)
    _plain(ax)


def _plain(ax: Axes) -> None:
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    ax.tick_params(labelsize=8)
    ax.xaxis.label.set_fontsize(9)  # type: ignore[attr-defined]  # by its alias
    ax.yaxis.label.set_fontsize(9)  # type: ignore[attr-defined]


def _subplots(
    rows: int, columns: int, *, width: float, height: float
) -> tuple[Figure, np.ndarray]:
    # Not pyplot: figures of a report belong to no window and need no closing.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    make: Callable[..., np.ndarray] = figure.subplots
    return figure, make(rows, columns, squeeze=False)
