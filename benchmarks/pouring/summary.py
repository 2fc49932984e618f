"""The paper's Figure 12 and the selected actions from the rows of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import stats

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
Rows = Sequence[Mapping[str, str]]
Cells = Mapping[tuple[str, str], Rows]  # by method and target


def summarize(cells: Cells) -> str:
    """Return all tables, the paper's figures beside ours.

    Args:
        cells: Rows by method and target.
    """
    if not cells:
        return "no trials yet"
    log_p, chosen = [], []
    for (method, target), rows in cells.items():
        rounds = range(1, max(int(r["round"]) for r in rows) + 1)
        by_round = [column(rows, "log_prob_true", r) for r in rounds]
        label = f"target {target}, {method.upper()}"
        last = by_round[-1]
        seconds = sum(
            np.array([float(r[f"cpu_{part}"]) for r in rows]).mean()
            for part in ("design", "trial")
        )
        log_p.append(
            [
                label,
                str(len(last)),
                " / ".join(f"{np.median(v):.2f}" for v in by_round),
                f"{last.min():.2f} .. {last.max():.2f}",
                PUBLISHED.get((method, target), "-"),
                f"{column(rows, 'power', rounds[-1]).mean():.2f}".replace("nan", "-"),
                f"{seconds:.0f}",
            ]
        )
        low = [(column(rows, "height", r) == 20).mean() for r in rounds]
        mesh = [column(rows, "delta", r).mean() for r in rounds]
        common = [
            np.mean(column(rows, "eig_mesh", r) - column(rows, "eig_pca", r))
            for r in rounds
        ]
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


def active_against_random(cells: Cells) -> list[str]:
    """Return whether designed actions have the higher median, round by round."""
    lines = []
    for target in ("1", "2"):
        if ("asbi", target) in cells and ("nsbi", target) in cells:
            ours, theirs = cells["asbi", target], cells["nsbi", target]
            last = max(int(r["round"]) for r in ours)
            gaps = [
                np.median(column(ours, "log_prob_true", r))
                - np.median(column(theirs, "log_prob_true", r))
                for r in range(2, last + 1)
            ]
            text = " / ".join(f"{gap:+.2f}" for gap in gaps)
            above = sum(gap > 0 for gap in gaps)
            lines.append(
                f"target {target}: ASBI above NSBI in median log p in {above} of "
                f"rounds 2 to {last} ({text})"
            )
    return lines


def coverage_table(cells: Cells) -> str:
    """Return how often the truth is within regions of highest density."""
    table = []
    for (method, _), rows in cells.items():
        for number in range(1, max(int(r["round"]) for r in rows) + 1):
            hpd = column(rows, "hpd", number)
            entry = [method.upper(), str(number), str(len(hpd))]
            for level in (0.5, 0.9):
                inside = int((hpd <= level).sum())
                low, high = stats.binom.interval(0.95, len(hpd), level)
                verdict = "within" if low <= inside <= high else "outside"
                entry.append(f"{inside} {verdict} {low:.0f}..{high:.0f}")
            log_p = column(rows, "log_prob_true", number)
            table.append([*entry, f"{log_p.mean():.2f}"])
    header = ["", "round", "truths", "in 50 % region", "in 90 % region", "mean log p"]
    return Table(header, table).text() if table else "no trials yet"
