"""The tables of the falling balls, in Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.display.table import Table

__all__ = ["called", "tables"]

Array = NDArray[Any]

#: Probability of the family from which it is the verdict.
LIKELY = 0.5
NUM_BOOTSTRAP = 4_000
COLUMNS = (
    "before",
    "after",
    "gravity alone",
    "free gravity",
    "linear drag",
    "quadratic drag",
)


def tables(rows: Sequence[dict[str, Any]]) -> str:
    """Return the verdicts a ball, and the errors over all folds.

    Args:
        rows: Of ``judge``, with "alarm", and of ``score``.
    """
    balls = [row for row in rows if "alarm" in row]
    folds = [row for row in rows if "tested" in row]
    return "\n\n".join([_verdicts(balls), _errors(folds), _folds(folds)])


def called(row: dict[str, Any]) -> str:
    """Return the verdict on a ball, that of the family for a drag."""
    drag = row["probability_of_drag"]
    if row["verdict"] != "none" and drag > LIKELY:
        return "drag-like"
    return row["verdict"]


def _verdicts(rows: Sequence[dict[str, Any]]) -> str:
    header = ["ball", "verdict", "P(drag)", "log BF", "not excluded (90 %)"]
    header += ["exponent, 5 to 95 %", "linear over quadratic, nats"]
    lines = []
    for row in rows:
        low, middle, high = row["exponent"]
        verdict, exponent, favor = called(row), "", ""
        if verdict == "drag-like":
            exponent = f"{middle:.2f} ({low:.2f} to {high:.2f})"
            favor = f"{row['linear_over_quadratic']:+.1f}"
        odds = f"{row['probability_of_drag']:.2f}", f"{row['log_bayes_factor']:.1f}"
        ball, kept = row["ball"].replace("_", " "), ", ".join(row["credible_set"])
        lines.append((ball, verdict, *odds, kept, exponent, favor))
    return Table(header, lines).markdown()


def _errors(rows: Sequence[dict[str, Any]]) -> str:
    """Return root mean squares over folds, with intervals over balls."""
    names = ["before", "after", *(f"{name}, least squares" for name in COLUMNS[2:])]
    header = [f"RMSE, m, {len(rows)} folds", *names, "after / before"]
    lines = []
    balls = sorted({row["ball"] for row in rows})
    rng = np.random.default_rng(0)
    resampled = rng.integers(len(balls), size=(NUM_BOOTSTRAP, len(balls)))
    for what in ("second drop", "forecast"):
        square = {
            name: np.array(
                [
                    np.mean([r[f"{what} {name}"] ** 2 for r in rows if r["ball"] == b])
                    for b in balls
                ]
            )
            for name in COLUMNS
        }
        cells = [_cell(square[name], resampled) for name in COLUMNS]
        ratio = np.sqrt(square["after"].mean() / square["before"].mean())
        many = np.sqrt(
            square["after"][resampled].mean(1) / square["before"][resampled].mean(1)
        )
        low, high = np.quantile(many, [0.05, 0.95])
        cells.append(f"{ratio:.2f} ({low:.2f} to {high:.2f})")
        lines.append([what, *cells])
    cover = [
        f"{np.mean([row[f'coverage {when}'] for row in rows]):.2f}"
        for when in ("before", "after")
    ]
    rest = [""] * (len(COLUMNS) - 1)
    lines.append(["90 % coverage of the forecast", *cover, *rest])
    return Table(header, lines).markdown()


def _cell(square: Array, resampled: Array) -> str:
    low, high = np.quantile(np.sqrt(square[resampled].mean(1)), [0.05, 0.95])
    return f"{np.sqrt(square.mean()):.2f} ({low:.2f} to {high:.2f})"


def _folds(rows: Sequence[dict[str, Any]]) -> str:
    errors = ("second drop, m", "forecast, m", "coverage")
    lines = []
    for row in rows:
        pairs = [
            f"{row[f'{what} before']:.2f} -> {row[f'{what} after']:.2f}"
            for what in ("second drop", "forecast", "coverage")
        ]
        drop, drag = f"{row['ball']} {row['tested']}", row["probability_of_drag"]
        lines.append((drop.replace("_", " "), called(row), f"{drag:.2f}", *pairs))
    return Table(("tested drop", "verdict", "P(drag)", *errors), lines).markdown()
