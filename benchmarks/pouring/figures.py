"""The paper's Figures 11 and 12 as pictures, from the committed rows.

python -m benchmarks pouring.figures docs/images
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pouring.summary import label
from benchmarks.rounds import by_round
from benchmarks.rows import read
from sbi_active.display.figures import save

RESULTS = Path(__file__).parent / "results"
COLORS: dict[str, str] = {"asbi": "C0", "nsbi": "C1", "alhi": "C2", "nlhi": "C7"}
CLIPPED = -7.0  # the paper's Figure 11 too shows no less


def subplots(num: int) -> tuple[Any, Any]:
    """Return a figure and its axes in a row."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6 * num, 3.6), layout="constrained")
    return figure, figure.subplots(1, num, squeeze=False)[0]


def boxes(axes: Any, by_round: dict[str, list[np.ndarray]], *, first: int = 1) -> None:
    """Draw one box a method and round, side by side, from a first round on."""
    width = 0.8 / max(len(by_round), 1)
    for k, (method, values) in enumerate(by_round.items()):
        place = np.arange(len(values)) + first + (k - (len(by_round) - 1) / 2) * width
        color = COLORS[method]  # pyright: ignore
        axes.boxplot(
            values,
            positions=place,
            widths=0.8 * width,
            manage_ticks=False,
            patch_artist=True,
            boxprops={"facecolor": "none", "edgecolor": color},
            medianprops={"color": color},
            whiskerprops={"color": color},
            capprops={"color": color},
            flierprops={"markeredgecolor": color, "markersize": 3},
        )
        middle = [np.median(v) for v in values]
        axes.plot(place, middle, color=color, lw=1, label=method.upper())
    axes.set_xlabel("round")
    axes.legend(fontsize=8)


def log_prob_figure(results: Path = RESULTS) -> Any:
    """Return log p(truth) by round: the paper's Figure 11."""
    figure, both = subplots(2)
    for target, axes in zip(("1", "2"), both, strict=True):
        shown = {}
        for method in COLORS:
            if rows := read(results / f"target_{target}_{method}.csv"):
                values = by_round(rows, "log_prob_true")
                shown[method] = [np.maximum(v, CLIPPED) for v in values]
        boxes(axes, shown)
        axes.axhline(0, color="0.5", ls=":", lw=1)
        axes.set_title(f"target {target}")
        axes.set_ylabel("log p(truth)")
    return figure


def selected_figure(results: Path = RESULTS) -> Any:
    """Return the share of actions by round, ASBI: the paper's Figure 12."""
    from matplotlib import colormaps

    colors = colormaps["tab20"]
    figure, both = subplots(2)
    every = [read(results / f"target_{target}_asbi.csv") for target in ("1", "2")]
    names = sorted({label(r) for rows in every for r in rows})
    for target, rows, axes in zip(("1", "2"), every, both, strict=True):
        rounds = sorted({int(r["round"]) for r in rows})
        below = np.zeros(len(rounds))
        for k, name in enumerate(names):
            share = np.array(
                [
                    np.mean([label(r) == name for r in rows if int(r["round"]) == n])
                    for n in rounds
                ]
            )
            hatch = "//" if name.endswith("PCA") else None
            axes.bar(
                rounds,
                share,
                bottom=below,
                label=name,
                color=colors(k % 20),
                hatch=hatch,
            )
            below += share
        axes.set_title(f"target {target}, ASBI")
        axes.set_xlabel("round")
        axes.set_ylabel("share of trials")
    bars, words = both[0].get_legend_handles_labels()
    figure.legend(
        bars,
        words,
        loc="outside right upper",
        fontsize=7,
        title="h cm, p cm, v rad/s",
        title_fontsize=7,
    )
    return figure


def main(folder: Path) -> None:
    """Draw figures 11 and 12.

    Args:
        folder: Folder to write to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    figures = {
        "log_prob.png": log_prob_figure(),
        "actions.png": selected_figure(),
    }
    for name, figure in figures.items():
        save(figure, str(folder / name))
