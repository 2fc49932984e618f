"""The paper's Table 2 and Figures 7 to 9 from the rows of a run."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.published import published
from benchmarks.rounds import (
    Cells,
    Rows,
    active_against_random,
    by_round,
    num_rounds,
)
from benchmarks.rows import column
from sbi_active.display.table import Table

REPORTED = (3.0, 5.0, 7.0)  # m/s
STAGES = ("simulation", "training", "design", "scoring", "update")
PARTS = {  # of a round, in the paper's words
    "simulation": ("simulation",),
    "training": ("training",),
    "information gain": ("design",),
    "refinement": ("scoring", "update"),
}
#: Table 2: mean and standard deviation of 50 trials, 1e-3 m, at 3, 5 and 7 m/s.
PUBLISHED = published("box collision")
#: Mean speeds of rounds 1 and 6, and seconds a round.
PUBLISHED_SPEEDS = published("box collision speeds")
(PUBLISHED_TIME,) = published("box collision time")["a round"]
COMPARED = 3  # round by which target 2 should be pushed more slowly

#: Of the reference's log p, nats, above which importance sampling has failed.
LARGEST_ERROR = 0.5
PAIRS = (("asbi", "nsbi"), ("alhi", "nlhi"))  # chosen and random actions


def summarize(cells: Cells) -> str:
    """Return all tables, the paper's figures beside ours.

    Args:
        cells: Rows by method and target.
    """
    if not cells:
        return "no trials yet"
    parts = [errors_table(cells), rounds_table(cells), time_table(cells)]
    return "\n\n".join(
        [*parts, *slower_pushes(cells), *active_against_random(cells, PAIRS)]
    )


def errors_table(cells: Cells) -> str:
    """Return Table 2: the reproduction errors of the last belief."""
    table = []
    for (method, target), rows in cells.items():
        last = num_rounds(rows)
        published = PUBLISHED.get(f"{method} {target}", ("-",) * len(REPORTED))
        trials = len(column(rows, "log_prob_true", last))
        entry = [f"target {target}", method.upper(), str(trials)]
        for speed, paper in zip(REPORTED, published, strict=True):
            ours = column(rows, f"rep_err_{speed:g}", last)
            limit = known(rows, f"exact_rep_err_{speed:g}", last)
            entry += [spread(ours), spread(limit), paper]
        table.append(entry)
    header = ["", "method", "trials"]
    for speed in REPORTED:
        header += [f"RepErr({speed:g}), 1e-3", "exact posterior's", "paper"]
    return Table(header, table).text()


def rounds_table(cells: Cells) -> str:
    """Return Figures 7 and 8 in numbers, and the gap to the exact posterior."""
    table = []
    for (method, target), rows in cells.items():
        last = num_rounds(rows)
        medians = [np.median(v) for v in by_round(rows, "log_prob_true")]
        speeds = [v.mean() for v in by_round(rows, "speed")]
        shares = [1 - v.mean() for v in by_round(rows, "is_valid")]
        table.append(
            [
                f"target {target}, {method.upper()}",
                " / ".join(f"{m:.2f}" for m in medians),
                gap(rows, last),
                " / ".join(f"{s:.1f}" for s in speeds),
                *PUBLISHED_SPEEDS.get(f"{method} {target}", ("-",)),
                " / ".join(f"{s:.2f}" for s in shares),
            ]
        )
    header = ["", "median log p(truth) by round", "gap: mean +- se, 95 % (se of exact)"]
    return Table([*header, "mean speed", "paper", "share off the table"], table).text()


def time_table(cells: Cells) -> str:
    """Return Figure 9 in numbers: what a round costs."""
    table = []
    for (method, target), rows in cells.items():
        entry = [f"target {target}, {method.upper()}"]
        for kind in ("cpu", "wall"):
            seconds = time_parts(rows, kind)
            cells_ = [f"{s:.1f}" for s in seconds.values()]
            entry.append(f"{sum(seconds.values()):.1f} ({' + '.join(cells_)})")
        entry.append(f"{column(rows, 'num_simulations').mean():.0f}")
        table.append(entry)
    names = " + ".join(PARTS)
    header = ["", f"CPU s a round ({names})", "wall s", "simulations a round"]
    return f"{Table(header, table).text()}\npaper, ASBI: {PUBLISHED_TIME}"


def time_parts(rows: Rows, kind: str) -> dict[str, float]:
    """Return mean seconds a round by part."""
    return {
        part: float(sum(column(rows, f"{kind}_{s}").mean() for s in stages))
        for part, stages in PARTS.items()
    }


def slower_pushes(cells: Cells) -> list[str]:
    """Return how often target 2 is pushed more slowly than target 1, by method."""
    lines = []
    for method in dict.fromkeys(method for method, _ in cells):
        if (method, "1") not in cells or (method, "2") not in cells:
            continue
        first, second = (by_seed(cells[method, t], COMPARED) for t in ("1", "2"))
        shared = sorted(first.keys() & second.keys())
        if shared:
            lower = sum(second[seed] < first[seed] for seed in shared)
            lines.append(
                f"{method.upper()}: slower for target 2 in round {COMPARED} in {lower} "
                f"of {len(shared)} trials ({lower / len(shared):.2f}; bar .80)"
            )
    return lines


def by_seed(rows: Rows, round_: int) -> dict[int, float]:
    """Return the speed chosen in a round, by seed."""
    return {
        int(r["seed"]): float(r["speed"]) for r in rows if int(r["round"]) == round_
    }


def gap(rows: Rows, round_: int) -> str:
    """Return the gap to the exact posterior: mean, its error, 95th percentile.

    Of trials whose reference is known well enough; how many are not is said.
    """
    every = np.isfinite(column(rows, "gap", round_)).sum()
    values = known(rows, "gap", round_)
    lost = f", {every - len(values)} of {every} unknown" if len(values) < every else ""
    if not len(values):
        return f"-{lost}"
    error = values.std(ddof=1) / len(values) ** 0.5 if len(values) > 1 else np.nan
    exact = known(rows, "log_p_exact_se", round_).max()
    percentile = np.percentile(values, 95)
    return f"{values.mean():.2f} +- {error:.2f}, {percentile:.2f} ({exact:.2f}){lost}"


def known(rows: Rows, key: str, round_: int) -> Any:
    """Return the reference's column where its log p is known within .5 nats."""
    values = column(rows, key, round_)
    return values[column(rows, "log_p_exact_se", round_) <= LARGEST_ERROR]


def spread(values: Any) -> str:
    """Return mean and standard deviation."""
    values = values[np.isfinite(values)]
    return f"{values.mean():.1f} +- {values.std():.1f}" if len(values) else "-"
