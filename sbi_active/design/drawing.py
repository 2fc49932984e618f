"""A picture of a design: what each action would tell."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sbi_active.arrays import Array

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

    dim = design.candidates.shape[1]
    is_category = design.categorical or (False,) * dim
    entries = [j for j in range(dim) if not is_category[j]]
    categories = [j for j in range(dim) if is_category[j]]
    panels = [("", np.arange(len(design.candidates)))]
    if categories and len(entries) <= 2:
        panels = _panels(design, categories)
    num = len(panels)
    columns = num if num <= 3 else int(np.ceil(num**0.5))
    if ax is None:
        size = (1 + 2.8 * columns, 2.6 * -(-num // columns))
        size = (6.4, 4.8) if num == 1 else size
        ax = plt.figure(figsize=size, layout="constrained").add_subplot()
    if len(entries) > 2:
        _bars(ax, design)
        return ax
    has_colors, marks = len(entries) == 2, None
    places = [ax] if num == 1 else _split(ax, num, columns, 0.92 if has_colors else 1.0)
    for panel, (title, members) in zip(places, panels, strict=True):
        if has_colors:
            marks = _map(panel, design, entries, members) or marks
        else:
            _curve(panel, design, entries[0], members)
        panel.set_title(title, fontsize=9)
    for k, panel in enumerate(places if num > 1 else []):
        panel.tick_params(labelsize=8)
        panel.locator_params(axis="x", nbins=4)
        if k % columns:
            panel.set_ylabel("")
            panel.tick_params(labelleft=False)
        if k + columns < num:
            panel.set_xlabel("")
    if has_colors and num == 1:
        ax.set_title("red circle: chosen", fontsize=9)
    if marks is not None:
        figure: Any = ax.figure
        beside = {"ax": ax}
        if num > 1:
            beside = {"cax": ax.inset_axes((0.95, 0.1, 0.02, 0.8))}
        figure.colorbar(marks, **beside).set_label(_gain_label(design))
    return ax


def labels_of(design: Any) -> list[str]:
    """Return names of the entries of the action, with units where known."""
    dim = design.candidates.shape[1]
    if design.labels:
        return [*design.labels]
    return [design.name] if dim == 1 else [f"action {j + 1}" for j in range(dim)]


def _gain_label(design: Any) -> str:
    return f"EIG{NOTES[design.bound]} [nats]"


def _panels(
    design: Any, categories: list[int], most: int = 12
) -> list[tuple[str, Array]]:
    """Return title and members of each panel, the chosen one's among them.

    Of many categories, those with the most information.
    """
    rows = design.candidates[:, categories].numpy()
    values, which = np.unique(rows, axis=0, return_inverse=True)
    which = which.reshape(-1)
    gain = design.expected_information_gain.nan_to_num(nan=0.0).numpy()
    best = [gain[which == k].max() for k in range(len(values))]
    best[which[design.index]] = np.inf
    panels = []
    for k in sorted(np.argsort(best)[::-1][:most]):
        parts = []
        for j, value in zip(categories, values[k], strict=True):
            name, _, unit = labels_of(design)[j].partition(" [")
            parts.append(f"{name} = {value:.4g} {unit.removesuffix(']')}".rstrip())
        panels.append((", ".join(parts), np.flatnonzero(which == k)))
    return panels


def _split(ax: Axes, num: int, columns: int, used: float) -> list[Axes]:
    """Return panels of common limits within axes, in the order of reading."""
    ax.set_axis_off()
    width, height = used / columns, 1.0 / -(-num // columns)
    panels: list[Axes] = []
    for k in range(num):
        i, j = divmod(k, columns)
        corner = (j * width, 1 - (i + 1) * height + 0.14 * height)
        first = panels[0] if panels else None
        size = 0.9 * width, 0.7 * height
        panels.append(ax.inset_axes((*corner, *size), sharex=first, sharey=first))
    return panels


def _curve(ax: Axes, design: Any, entry: int, members: Array) -> None:
    """Draw the gain over one entry of the action, with two standard errors."""
    order = members[design.candidates[members, entry].argsort()]
    place = design.candidates[order, entry].numpy()
    gain, error = design.expected_information_gain, design.standard_error
    two = 2 * error[order].numpy()
    ax.errorbar(place, gain[order].numpy(), two, fmt="o-", ms=4, capsize=2)
    if design.index in members:
        chosen = float(design.candidates[design.index, entry])
        ax.axvline(chosen, ls=":", color="k", label="chosen")
        ax.legend()
    ax.set(xlabel=labels_of(design)[entry], ylabel=_gain_label(design))


def _map(ax: Axes, design: Any, entries: list[int], members: Array) -> Any:
    """Draw the gain over two entries as colors; return what the color bar needs."""
    x, y = design.candidates[members][:, entries].double().T.numpy()
    every = design.expected_information_gain.numpy()
    gain, marks = every[members], None
    if np.isfinite(every).any():
        low, high = np.nanmin(every), np.nanmax(every)
        known = np.isfinite(gain)
        points = np.stack([x, y], 1)[known]
        if len(points) >= 12 and high > low and not _on_a_line(points):
            levels = np.linspace(low, high, 12)
            ax.tricontourf(
                x[known], y[known], gain[known], levels, alpha=0.35, zorder=1
            )
        style: dict[str, Any] = {"s": 26, "lw": 0.6, "edgecolors": "w", "zorder": 3}
        marks = ax.scatter(x, y, c=gain, vmin=low, vmax=high, **style)
    else:
        ax.plot(x, y, "o", color="#9aa3ab", ms=4)
    if design.index in members:
        ring: dict[str, Any] = {"ms": 13, "mfc": "none", "mec": CHOSEN, "mew": 2}
        for action in np.atleast_2d(design.action.numpy())[:, entries]:
            ax.plot(*action[:, None], "o", zorder=4, label="chosen", **ring)
    first, second = (labels_of(design)[j] for j in entries)
    ax.set(xlabel=first, ylabel=second)
    return marks


def _on_a_line(points: Array) -> bool:
    scaled = (points - points.mean(0)) / np.maximum(np.ptp(points, 0), 1e-300)
    return bool(np.linalg.matrix_rank(scaled, tol=1e-3) < 2)


def _bars(ax: Axes, design: Any, most: int = 15) -> None:
    """Draw the best candidates in order, the chosen one among them.

    Labels of more run into each other.
    """
    gain = design.expected_information_gain.double().numpy()
    error = design.standard_error.double().numpy()
    order = np.argsort(-np.nan_to_num(gain, nan=-np.inf), kind="stable")[:most]
    if design.index not in order:
        order = np.append(order[:-1], design.index)
    order = order[::-1].copy()
    names = [name.partition(" [")[0] for name in labels_of(design)]
    rows = design.candidates[order].numpy()
    if len(names) <= 4:
        ticks = [", ".join(map("{} {:.4g}".format, names, row)) for row in rows]
    else:
        ticks = [", ".join(f"{v:.3g}" for v in row) for row in rows]
        ax.set_ylabel(", ".join(names), fontsize=8)
    where, two = np.arange(len(order)), 2 * np.nan_to_num(error[order])
    colors = [CHOSEN if k == design.index else "C0" for k in order]
    ax.barh(where, np.nan_to_num(gain[order]), color=colors, height=0.7)
    ax.errorbar(gain[order], where, xerr=two, fmt="none", ecolor="k", capsize=2)
    ax.set_yticks(where, ticks, fontsize=8)
    how = "chosen at random" if np.isnan(gain).all() else "red: chosen"
    left = len(gain) - len(order)
    ax.set_title(how + (f"; {left} further candidates" if left else ""), fontsize=9)
    ax.set_xlabel(_gain_label(design))
