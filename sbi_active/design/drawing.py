"""A picture of a design: what each action would tell."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CHOSEN = "#c1432e"
NOTES = {"lower": " (lower bound)", "upper": " (upper bound)", "none": ""}


def draw(design: Any, ax: Axes | None = None) -> Axes:
    """Draw a design, see :meth:`.Design.plot`.

    Args:
        design: A :class:`.Design`.
        ax: Axes to draw on; None makes a figure.
    """
    import matplotlib.pyplot as plt

    if ax is None:
        ax = plt.figure(layout="constrained").add_subplot()
    dim = design.candidates.shape[1]
    {1: _curve, 2: _map}.get(dim, _bars)(ax, design)
    return ax


def labels_of(design: Any) -> list[str]:
    """Return names of the entries of the action, with units where known."""
    dim = design.candidates.shape[1]
    return [*design.labels] or [f"action {j + 1}" for j in range(dim)]


def _gain_label(design: Any) -> str:
    return f"EIG{NOTES[design.bound]} [nats]"


def _curve(ax: Axes, design: Any) -> None:
    """Draw the gain over the only entry of the action, with two standard errors."""
    order = design.candidates[:, 0].argsort()
    gain, two = design.expected_information_gain, 2 * design.standard_error
    place = design.candidates[order, 0].numpy()
    style: dict[str, Any] = {"fmt": "o-", "ms": 4, "capsize": 2}
    ax.errorbar(place, gain[order].numpy(), two[order].numpy(), **style)
    chosen = float(design.candidates[design.index, 0])
    ax.axvline(chosen, ls=":", color="k", label="chosen")
    ax.legend()
    ax.set(xlabel=labels_of(design)[0], ylabel=_gain_label(design))


def _map(ax: Axes, design: Any) -> None:
    """Draw the gain over two entries as colors, the chosen action in a ring."""
    style: dict[str, Any] = {"s": 26, "lw": 0.6, "edgecolors": "w", "zorder": 3}
    gain = design.expected_information_gain.numpy()
    marks = ax.scatter(*design.candidates.double().T.numpy(), c=gain, **style)
    if np.isfinite(gain).any():
        figure: Any = ax.figure
        figure.colorbar(marks, ax=ax).set_label(_gain_label(design))
    ring: dict[str, Any] = {"ms": 13, "mfc": "none", "mec": CHOSEN, "mew": 2}
    for action in np.atleast_2d(design.action.numpy()):
        ax.plot(*action[:, None], "o", zorder=4, label="chosen", **ring)
    first, second = labels_of(design)
    ax.set(xlabel=first, ylabel=second, title="red circle: chosen")


def _bars(ax: Axes, design: Any, most: int = 15) -> None:
    """Draw the best candidates in order, the chosen one among them.

    Labels of more run into each other.
    """
    gain = design.expected_information_gain.double().numpy()
    order = np.argsort(-np.nan_to_num(gain, nan=-np.inf), kind="stable")[:most]
    if design.index not in order:
        order = np.append(order[:-1], design.index)
    order = order[::-1].copy()
    names = ", ".join(name.partition(" [")[0] for name in labels_of(design))
    rows = design.candidates[order].numpy()
    where, two = np.arange(len(order)), 2 * design.standard_error[order].numpy()
    colors = [CHOSEN if k == design.index else "C0" for k in order]
    ax.barh(where, np.nan_to_num(gain[order]), color=colors, height=0.7)
    ax.errorbar(gain[order], where, xerr=two, fmt="none", ecolor="k", capsize=2)
    ax.set_yticks(where, [", ".join(f"{v:.3g}" for v in row) for row in rows])
    ax.tick_params(axis="y", labelsize=8)
    how = "chosen at random" if np.isnan(gain).all() else "red: chosen"
    left = len(gain) - len(order)
    ax.set_title(how + (f"; {left} further candidates" if left else ""), fontsize=9)
    ax.set_xlabel(_gain_label(design))
    ax.set_ylabel(names, fontsize=8)
