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

    panels = _panels(design)
    rows, columns = _grid(len(panels))
    if ax is None:
        size = (6.4, 4.8) if len(panels) == 1 else (1 + 2.8 * columns, 2.6 * rows)
        ax = plt.subplots(figsize=size, layout="constrained")[1]
    is_category = _categories(design)
    own = [j for j, category in enumerate(is_category) if not category]
    if len(own) > 2:
        _bars(ax, design)
        return ax
    places = [ax]
    if len(panels) > 1:
        places = _split(ax, len(panels), has_colors=len(own) == 2)
    marks = None
    for k, (panel, (title, members)) in enumerate(zip(places, panels, strict=True)):
        if len(own) == 2:
            marks = _map(panel, design, own, members) or marks
        else:
            _curve(panel, design, own[0], members)
        if title:
            panel.set_title(title, fontsize=9)
        if len(panels) > 1:
            _outer_labels(panel, k, columns, len(panels))
    if len(own) == 2:
        _same_limits(places, design.candidates[:, own].numpy())
        if len(panels) == 1:
            ax.set_title("red circle: chosen", fontsize=9)
    elif len(places) > 1:
        _same_heights(places)
    _bar_of_colors(ax, design, marks, len(panels))
    return ax


def labels_of(design: Any) -> list[str]:
    """Return names of the entries of the action, with units where known."""
    dim = design.candidates.shape[1]
    if design.labels:
        return [*design.labels]
    return [design.name] if dim == 1 else [f"action {j + 1}" for j in range(dim)]


def _gain_label(design: Any) -> str:
    return f"EIG{NOTES[design.bound]} [nats]"


def _categories(design: Any) -> tuple[bool, ...]:
    return design.categorical or (False,) * design.candidates.shape[1]


def _panels(design: Any, most: int = 12) -> list[tuple[str, Array]]:
    """Return title and members of each panel, the chosen one's among them.

    Of many categories, those with the most information.
    """
    everything = np.arange(len(design.candidates))
    category = [j for j, is_one in enumerate(_categories(design)) if is_one]
    if not category or len(_categories(design)) - len(category) > 2:
        return [("", everything)]
    rows = design.candidates[:, category].numpy()
    values, which = np.unique(rows, axis=0, return_inverse=True)
    which = which.reshape(-1)
    gain = design.expected_information_gain.nan_to_num(nan=0.0).numpy()
    best = [gain[which == k].max() for k in range(len(values))]
    best[which[design.index]] = np.inf
    shown = sorted(np.argsort(best)[::-1][:most])
    names = [labels_of(design)[j] for j in category]
    return [(_setting(names, values[k]), everything[which == k]) for k in shown]


def _setting(names: list[str], values: Array) -> str:
    """Return an action in words, each entry with its name and unit."""
    parts = []
    for name, value in zip(names, values, strict=True):
        name, _, unit = name.partition(" [")
        parts.append(f"{name} = {value:.4g} {unit.removesuffix(']')}".rstrip())
    return ", ".join(parts)


def _grid(num: int) -> tuple[int, int]:
    columns = num if num <= 3 else int(np.ceil(num**0.5))
    return -(-num // columns), columns


def _split(ax: Axes, num: int, *, has_colors: bool) -> list[Axes]:
    """Return panels within axes, in the order of reading."""
    ax.set_axis_off()
    rows, columns = _grid(num)
    width, height = (0.92 if has_colors else 1.0) / columns, 1.0 / rows
    found = []
    for k in range(num):
        i, j = divmod(k, columns)
        corner = (j * width, 1 - (i + 1) * height + 0.14 * height)
        found.append(ax.inset_axes((*corner, 0.9 * width, 0.7 * height)))
    return found


def _outer_labels(panel: Axes, k: int, columns: int, num: int) -> None:
    panel.tick_params(labelsize=8)
    panel.locator_params(axis="x", nbins=4)
    if k % columns:
        panel.set_ylabel("")
        panel.set_yticklabels([])
    if k + columns < num:
        panel.set_xlabel("")


def _same_limits(panels: list[Axes], places: Array) -> None:
    low, high = places.min(0), places.max(0)
    room = 0.06 * np.where(high > low, high - low, 1.0)
    for panel in panels:
        panel.set_xlim(low[0] - room[0], high[0] + room[0])
        panel.set_ylim(low[1] - room[1], high[1] + room[1])


def _same_heights(panels: list[Axes]) -> None:
    ends = np.array([panel.get_ylim() for panel in panels])
    for panel in panels:
        panel.set_ylim(ends[:, 0].min(), ends[:, 1].max())


def _curve(ax: Axes, design: Any, entry: int, members: Array) -> None:
    """Draw the gain over one entry of the action, with two standard errors."""
    place = design.candidates[members, entry]
    order = place.argsort()
    gain, error = (
        part[members][order].numpy()
        for part in (design.expected_information_gain, design.standard_error)
    )
    ax.errorbar(place[order].numpy(), gain, 2 * error, fmt="o-", ms=4, capsize=2)
    if design.index in members:
        chosen = float(design.candidates[design.index, entry])
        ax.axvline(chosen, ls=":", color="k", label="chosen")
        ax.legend()
    ax.set_xlabel(labels_of(design)[entry])
    ax.set_ylabel(_gain_label(design))


def _map(ax: Axes, design: Any, own: list[int], members: Array) -> Any:
    """Draw the gain over two entries as colors; return what the color bar needs."""
    x, y = design.candidates[members][:, own].double().T.numpy()
    gain = design.expected_information_gain.numpy()
    marks = None
    if np.isfinite(gain).any():
        ends = {"vmin": np.nanmin(gain), "vmax": np.nanmax(gain)}
        known = np.isfinite(gain[members])
        if known.sum() >= 12:
            _fill(ax, x[known], y[known], gain[members][known], ends)
        marks = ax.scatter(
            *(x, y), c=gain[members], s=26, lw=0.6, edgecolors="w", zorder=3, **ends
        )
    else:
        ax.plot(x, y, "o", color="#9aa3ab", ms=4)
    if design.index in members:
        for action in np.atleast_2d(design.action.numpy())[:, own]:
            ax.plot(
                *(action[0], action[1], "o"),
                **{"ms": 13, "mfc": "none", "mec": CHOSEN, "mew": 2, "zorder": 4},
                label="chosen",
            )
    first, second = (labels_of(design)[j] for j in own)
    ax.set(xlabel=first, ylabel=second)
    return marks


def _fill(ax: Axes, x: Array, y: Array, gain: Array, ends: dict[str, float]) -> None:
    """Fill in between the candidates, unless they lie on a line."""
    spread = np.linalg.svd(_unit(x, y), compute_uv=False)
    if spread[-1] > 1e-3 * spread[0] and ends["vmax"] > ends["vmin"]:
        levels = np.linspace(ends["vmin"], ends["vmax"], 12)
        ax.tricontourf(x, y, gain, levels=levels, alpha=0.35, zorder=1)


def _unit(x: Array, y: Array) -> Array:
    z = np.stack([x - x.mean(), y - y.mean()], 1)
    return z / np.maximum(np.abs(z).max(0), 1e-300)


def _bar_of_colors(ax: Axes, design: Any, marks: Any, num_panels: int) -> None:
    if marks is None:
        return
    figure: Any = ax.figure
    if num_panels == 1:
        bar = figure.colorbar(marks, ax=ax)
    else:
        bar = figure.colorbar(marks, cax=ax.inset_axes((0.95, 0.1, 0.02, 0.8)))
    bar.set_label(_gain_label(design))


def _bars(ax: Axes, design: Any, most: int = 15) -> None:
    """Draw the best candidates in order, the chosen one among them.

    Labels of more run into each other.
    """
    gain, error = (
        part.double().numpy()
        for part in (design.expected_information_gain, design.standard_error)
    )
    order = np.argsort(-np.nan_to_num(gain, nan=-np.inf), kind="stable")[:most]
    if design.index not in order:
        order = np.append(order[:-1], design.index)
    order = order[::-1]
    names = labels_of(design)
    short = [name.partition(" [")[0] for name in names]
    rows = design.candidates[order.copy()].numpy()
    if len(names) <= 4:
        ticks = [", ".join(map("{} {:.4g}".format, short, row)) for row in rows]
    else:
        ticks = [", ".join(f"{v:.3g}" for v in row) for row in rows]
        ax.set_ylabel(", ".join(short), fontsize=8)
    where = np.arange(len(order))
    colors = [CHOSEN if k == design.index else "C0" for k in order]
    ax.barh(where, np.nan_to_num(gain[order]), color=colors, height=0.7)
    if np.isfinite(gain).any():
        two = 2 * np.nan_to_num(error[order])
        ax.errorbar(gain[order], where, xerr=two, fmt="none", ecolor="k", capsize=2)
    chosen = int(np.nonzero(order == design.index)[0][0])
    ax.set_yticks(where, ticks, fontsize=8)
    ax.get_yticklabels()[chosen].set_color(CHOSEN)
    how = "chosen at random" if np.isnan(gain).all() else "red: chosen"
    left = len(gain) - len(order)
    ax.set_title(how + (f"; {left} further candidates" if left else ""), fontsize=9)
    ax.set_xlabel(_gain_label(design))
