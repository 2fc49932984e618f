"""The paper's Figure 12 and the selected actions from the rows of a run."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from benchmarks.rounds import Cells, Rows, active_against_random, by_round
from benchmarks.rows import column
from sbi_active.display.table import Table

#: Section 5.4, read from the text: medians of ASBI after the first and last rounds.
PUBLISHED = {
    ("asbi", "1"): "above 1.0 .. over 2.6",
    ("asbi", "2"): "around 0.8 .. above 3.6",
    ("nsbi", "1"): "near 0",
    ("nsbi", "2"): "near 0",
    ("alhi", "1"): "below -7",
    ("alhi", "2"): "below -7",
}


def summarize(cells: Cells) -> str:
    """Return all tables, the paper's figures beside ours.

    Args:
        cells: Rows by method and target.
    """
    if not cells:
        return "no trials yet"
    log_p, chosen = [], []
    for (method, target), rows in cells.items():
        log_probs = by_round(rows, "log_prob_true")
        label = f"target {target}, {method.upper()}"
        last = log_probs[-1]
        seconds = sum(
            np.array([float(r[f"cpu_{part}"]) for r in rows]).mean()
            for part in ("design", "trial")
        )
        log_p.append(
            [
                label,
                str(len(last)),
                " / ".join(f"{np.median(v):.2f}" for v in log_probs),
                f"{last.min():.2f} .. {last.max():.2f}",
                PUBLISHED.get((method, target), "-"),
                f"{by_round(rows, 'power')[-1].mean():.2f}".replace("nan", "-"),
                f"{seconds:.0f}",
            ]
        )
        low = [(v == 20).mean() for v in by_round(rows, "height")]
        mesh = [v.mean() for v in by_round(rows, "delta")]
        pairs = zip(by_round(rows, "eig_mesh"), by_round(rows, "eig_pca"), strict=True)
        common = [np.mean(one - other) for one, other in pairs]
        chosen.append(
            [
                label,
                " / ".join(f"{v:.2f}" for v in low),
                " / ".join(f"{v:.2f}" for v in mesh),
                "-"
                if np.isnan(common).any()
                else " / ".join(f"{v:+.2f}" for v in common),
            ]
        )
    first = Table(
        ["", "trials", "median log p(truth) by round", "last: min .. max"]
        + ["paper (1,000 cubes)", "mean power", "CPU s a round"],
        log_p,
    ).text()
    second = Table(
        ["", "share at h = 20 cm", "share by mesh coverage", "gain: mesh less PCA"],
        chosen,
    ).text()
    shares = [actions_table(cells[key], key[1]) for key in cells if key[0] == "asbi"]
    return "\n\n".join([first, second, *shares, *active_against_random(cells)])


def label(row: Mapping[str, str]) -> str:
    """Return an action in words."""
    numbers = (float(row[k]) for k in ("height", "position", "rate"))
    summary = "mesh" if int(row["delta"]) else "PCA"
    return ", ".join(f"{v:g}" for v in numbers) + f", {summary}"


def actions_table(rows: Rows, target: str) -> str:
    """Return the share of trials at each action that was chosen, round by round."""
    rounds = sorted({int(r["round"]) for r in rows})
    table = []
    for name in sorted({label(r) for r in rows}):
        share = [
            np.mean([label(r) == name for r in rows if int(r["round"]) == number])
            for number in rounds
        ]
        table.append([name, " / ".join(f"{v:.1f}" for v in share)])
    head = f"target {target}: h cm, p cm, v rad/s, summary"
    return Table([head, "share of ASBI's trials by round"], table).text()


def mean_log_p(rows: Rows, number: int) -> str:
    """Return the mean log p(truth) of a round."""
    return f"{column(rows, 'log_prob_true', number).mean():.2f}"
