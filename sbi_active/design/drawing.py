"""A picture of a design: what each action would tell."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

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
    drawn = _map if design.candidates.shape[1] == 2 else _curve
    drawn(ax, design)
    return ax


def labels_of(design: Any) -> list[str]:
    """Return names of the entries of the action, with units where known."""
    dim = design.candidates.shape[1]
    return [*design.labels] or [f"action {j + 1}" for j in range(dim)]


def _gain_label(design: Any) -> str:
    return f"EIG{NOTES[design.bound]} [nats]"


def _curve(ax: Axes, design: Any) -> None:
    """Draw the gain with two standard errors, over the entry or from the best on."""
    gain, two = design.expected_information_gain, 2 * design.standard_error
    order = gain.nan_to_num(nan=-np.inf).argsort(descending=True, stable=True)
    place, label = torch.arange(len(order)), "candidates, the best first"
    if design.candidates.shape[1] == 1:
        order = design.candidates[:, 0].argsort()
        place, (label,) = design.candidates[order, 0], labels_of(design)
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
    ring: dict[str, Any] = {"ms": 13, "mfc": "none", "mec": CHOSEN, "mew": 2}
    for action in np.atleast_2d(design.action.numpy()):
        ax.plot(*action[:, None], "o", zorder=4, label="chosen", **ring)
    first, second = labels_of(design)
    ax.set(xlabel=first, ylabel=second, title="red circle: chosen")
