"""Panels of a figure: a design, and residuals of trials before and after."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from sbi_active.arrays import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BEFORE, AFTER, FAINT = "#c1432e", "#2f6f9f", "#9aa3ab"
BOUNDS = {"lower": " (lower bound)", "upper": " (upper bound)", "none": ""}


def plot_residuals(
    rows: Mapping[str, Any],
    *,
    action_labels: Sequence[str] = (),
    channel_names: Sequence[str] | None = None,
) -> Figure:
    """Draw standardized residuals by action, trial, and channel or time.

    The band is two standard deviations.

    Args:
        rows: Residuals of two models at most, a row each, by their titles: objects with
            ``refitted`` residuals, of the shape of x (n, k, ...), and by trial
            ``action``, ``index``, ``names`` and ``times``.
        action_labels: Labels of the entries of the action, with their units; none where
            the action is only the trial's number.
        channel_names: Names of the entries of x without a time axis.

    Returns:
        The figure.
    """
    first, shown = next(iter(rows.values())), min(len(action_labels), 3)
    several = first.refitted[0].size > 1
    figure, axes = _subplots(len(rows), shown + 1 + several, width=3.3, height=2.5)
    colors = BEFORE, AFTER
    for line, (title, residuals), color in zip(
        axes, rows.items(), colors, strict=False
    ):
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


def _by_entry(
    ax: Axes, residuals: Any, color: str, channel_names: Sequence[str] | None
) -> None:
    """Draw one line a trial over time, or points over the channels."""
    each = residuals.refitted.reshape(len(residuals.index), -1)
    if residuals.times is not None:
        length = residuals.refitted.shape[1]
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


def _trial_axis(ax: Axes, residuals: Any) -> None:
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
    ax.axhspan(-2, 2, color="#dde3e8", zorder=0)
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


def plot_design(design: Any, ax: Axes | None = None) -> Axes:
    """Draw what candidates tell, see :meth:`.Design.plot`.

    Args:
        design: A :class:`.Design`.
        ax: Axes to draw on; None makes a figure.
    """
    import matplotlib.pyplot as plt

    if ax is None:
        ax = plt.figure(layout="constrained").add_subplot()
    drawn = _map if design.candidates.shape[1] == 2 else _curve
    drawn(ax, design)
    return ax


def _labels(design: Any) -> list[str]:
    """Return names of the entries of the action, with units where known."""
    dim = design.candidates.shape[1]
    return [*design.labels] or [f"action {j + 1}" for j in range(dim)]


def _gain_label(design: Any) -> str:
    return f"EIG{BOUNDS[design.bound]} [nats]"


def _curve(ax: Axes, design: Any) -> None:
    """Draw the gain with two standard errors, over the entry or from the best on."""
    gain, two = design.expected_information_gain, 2 * design.standard_error
    order = gain.nan_to_num(nan=-np.inf).argsort(descending=True, stable=True)
    label, place = "candidates, the best first", torch.arange(len(order))
    if design.candidates.shape[1] == 1:
        order = design.candidates[:, 0].argsort()
        (label,), place = _labels(design), design.candidates[order, 0]
    style: dict[str, Any] = {"fmt": "o-", "ms": 4, "capsize": 2}
    ax.errorbar(place.numpy(), gain[order].numpy(), two[order].numpy(), **style)
    ax.axvline(float(place[order == design.index]), ls=":", color="k", label="chosen")
    ax.legend()
    ax.set(xlabel=label, ylabel=_gain_label(design))


def _map(ax: Axes, design: Any) -> None:
    """Draw the gain over two entries as colors, the chosen action in a ring."""
    style: dict[str, Any] = {"s": 26, "lw": 0.6, "edgecolors": "w", "zorder": 3}
    gain = design.expected_information_gain.numpy()
    marks = ax.scatter(*design.candidates.double().T.numpy(), c=gain, **style)
    if np.isfinite(gain).any():
        figure: Any = ax.figure
        figure.colorbar(marks, ax=ax).set_label(_gain_label(design))
    ring: dict[str, Any] = {"ms": 13, "mfc": "none", "mec": BEFORE, "mew": 2}
    for action in np.atleast_2d(design.action.numpy()):
        ax.plot(*action[:, None], "o", zorder=4, label="chosen", **ring)
    first, second = _labels(design)
    ax.set(xlabel=first, ylabel=second, title="red circle: chosen")
