"""Figure 16 of the paper, from the rows of a run."""

from __future__ import annotations

import numpy as np

from benchmarks.rounds import Rows
from sbi_active.display.table import Table

#: Section 6, medians of ASBI, mm summed over pixels of 1,000 particles, and how far
#: NSBI is below it at the last round.
PUBLISHED = {
    "beads": ("0.95e4 .. 1.20e4", "24 %"),
    "gravel": ("1.32e4 .. 2.13e4", "13 %"),
}


def by_round(rows: Rows, material: str, method: str) -> list[np.ndarray]:
    """Return InterVol of the trials of a cell, an array a round."""
    mine = [r for r in rows if (r["material"], r["method"]) == (material, method)]
    rounds = sorted({int(r["round"]) for r in mine})
    return [
        np.array([float(r["intervol"]) for r in mine if int(r["round"]) == k])
        for k in rounds
    ]


def summarize(rows: Rows) -> str:
    """Return InterVol by round, the paper's beside it."""
    if not rows:
        return "no trials yet"
    table, lines = [], []
    for material, (paper, behind) in PUBLISHED.items():
        last = {}
        for method in ("asbi", "nsbi"):
            values = by_round(rows, material, method)
            if not values:
                continue
            last[method] = values[-1]
            medians = [np.median(v) for v in values]
            mine = [
                r for r in rows if (r["material"], r["method"]) == (material, method)
            ]
            low = [r["position"] == "0" for r in mine if r["height"]]
            table.append(
                [
                    f"{material}, {method.upper()}",
                    str(len(values[-1])),
                    " / ".join(f"{v:.0f}" for v in medians),
                    f"{values[-1].min():.0f} .. {values[-1].max():.0f}",
                    f"{medians[-1] / medians[0] - 1:+.0%}",
                    f"{np.mean(low):.2f}",
                    paper if method == "asbi" else f"{behind} below",
                ]
            )
        if len(last) == 2:
            ours, theirs = np.median(last["asbi"]), np.median(last["nsbi"])
            pairs = (last["asbi"] > last["nsbi"]).sum()
            lines.append(
                f"{material}: ASBI's median is {ours / theirs:.2f} of NSBI's at the "
                f"last round, and above it in {pairs} of {len(last['asbi'])} pairs"
            )
    header = ["", "trials", "median InterVol by round, mm", "last: min .. max"]
    header += ["last to first", "share at p = 0", "paper (1,000, a robot)"]
    return "\n\n".join([Table(header, table).text(), *lines])


def checks_table(rows: Rows) -> str:
    """Return InterVol of fresh pours of the last beliefs beside the learned one."""
    if not rows:
        return ""
    table = [
        [
            f"{r['material']}, {r['method'].upper()}, {r['seed']}",
            r["num"],
            f"{float(r['poured']):.0f} +- {float(r['poured_se']):.0f}",
            f"{float(r['learned']):.0f}",
        ]
        for r in rows
    ]
    gap = np.array([float(r["learned"]) - float(r["poured"]) for r in rows])
    error = np.array([float(r["poured_se"]) for r in rows])
    text = Table(["last belief of", "pours", "poured anew", "learned"], table).text()
    spread, noise = np.sqrt((gap**2).mean()), np.sqrt((error**2).mean())
    return (
        f"\n{text}\nlearned less poured: {gap.mean():+.0f} mm at the mean, root mean "
        f"square {spread:.0f}, of an error of {noise:.0f}"
    )
