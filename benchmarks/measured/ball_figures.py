"""The figures of the falling balls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchmarks.measured.ball_forecast import Forecast
from sbi_active.tasks.ball_drops import Drop  # pyright: ignore

BEFORE, AFTER, FAINT = "#b5533c", "#2b6a8f", "#8a949c"


def draw_exponents(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw the exponent of the drag of balls that show one.

    Args:
        rows: Of ``judge``.
        path: Of the PNG.
    """
    shown = [*rows][::-1]
    figure = Figure(figsize=(5.5, 0.7 + 0.28 * len(shown)), layout="constrained")
    ax = figure.subplots()
    for y, row in enumerate(shown):
        low, middle, high = row["exponent"]
        ax.plot([low, high], [y, y], color=AFTER, lw=3, solid_capstyle="round")
        ax.plot(middle, y, "o", color=AFTER, ms=6)
    for exponent, name in ((1.0, "linear"), (2.0, "quadratic")):
        ax.axvline(exponent, color=FAINT, lw=0.8, ls=":", zorder=0)
        ax.annotate(
            name,
            (exponent, len(shown) - 0.4),
            ha="center",
            va="bottom",
            fontsize=8,
            color="#555555",
        )
    ax.set_yticks(range(len(shown)), [r["ball"].replace("_", " ") for r in shown])
    ax.set(xlim=(0.45, 2.55), ylim=(-0.6, len(shown) - 0.4))
    ax.set_xlabel("exponent of the drag, 5 % to 95 %", fontsize=9)
    _plain(ax)
    figure.savefig(path, dpi=110)


def draw_forecasts(
    forecasts: Mapping[str, Mapping[str, Forecast]],
    drops: Mapping[str, Drop],
    path: Path,
    *,
    until: float,
) -> None:
    """Draw what each model expects of the rest of some drops.

    Args:
        forecasts: By the panel's title, "before" and "after".
        drops: The drops that are forecast, by title.
        path: Of the PNG.
        until: Where the forecast begins, s.
    """
    num = len(forecasts)
    figure = Figure(figsize=(3.3 * num, 2.9), layout="constrained")
    axes = figure.subplots(1, num, squeeze=False, sharey=True)[0]
    for ax, (title, found) in zip(axes, forecasts.items(), strict=True):
        drop = drops[title]
        ax.plot(drop.times, drop.heights, "k.", ms=3.5, label="measured", zorder=3)
        for when, color, label in (
            ("before", BEFORE, "gravity alone"),
            ("after", AFTER, "average of the models"),
        ):
            one = found[when]
            ax.plot(one.times, one.mean, color=color, lw=1.5, label=label)
            ax.fill_between(one.times, one.low, one.high, color=color, alpha=0.2, lw=0)
        ax.axvline(until, color=FAINT, lw=0.8, ls=":")
        ax.set_title(title, fontsize=9)
        ax.set_xlabel("time [s]", fontsize=9)
        _plain(ax)
    axes[0].set_ylabel("height [m]", fontsize=9)
    axes[0].legend(fontsize=7, frameon=False, loc="lower left")
    figure.savefig(path, dpi=110)


def _plain(ax: Any) -> None:
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    ax.tick_params(labelsize=8)
