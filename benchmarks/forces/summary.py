"""The table of verdicts over hidden forces."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from benchmarks.criticism.intervals import rate
from sbi_active.criticism.forces.dictionary import FORMS
from sbi_active.display.table import Table

Row = dict[str, str]


def family_of(name: str) -> str:
    """Return the family of an effect of the dictionary by its name."""
    form, _, joint = name.partition(" of ")
    if " on " in joint:
        return f"coupling with {joint.split(' on ')[1]}"
    return f"force in {FORMS[form][0]} of {joint}"


def _falls(row: Row) -> bool:
    return float(row["held_after"]) < float(row["held_bare"])


def _rises(row: Row) -> bool:
    return float(row["held_after"]) > float(row["held_bare"]) * 1.0001


MEASURES: dict[str, list[tuple[str, Callable[[Row], bool]]]] = {
    "single": [
        ("right family", lambda r: family_of(r["form"]) == r["family"]),
        ("right form on top", lambda r: r["verdict"] == r["form"]),
        ("truth in the 95 % set", lambda r: r["form"] in r["set"].split(" | ")),
        ("called a stand-in", lambda r: bool(r["stand_in"])),
        ("withdrawn", lambda r: r["refuted"] == "1"),
        ("held-out error falls", _falls),
    ],
    "outside": [
        ("held-out error falls", _falls),
        ("called a stand-in", lambda r: bool(r["stand_in"])),
        ("called a stand-in, or nothing named", lambda r: is_flagged(r)),
        ("error rises, and no stand-in", lambda r: _rises(r) and not is_flagged(r)),
        ("error rises with a stand-in", lambda r: _rises(r) and is_flagged(r)),
    ],
    "clean": [("something named", lambda r: r["verdict"] != "none")],
    "magnet": [
        ("a force in q", lambda r: r["family"] == "force in q of hinge"),
        ("held-out error falls", _falls),
    ],
}


def is_flagged(row: Row) -> bool:
    """Return whether the verdict says that nothing declared explains the trials."""
    withdrawn = row["refuted"] == "1"
    return bool(row["stand_in"]) or withdrawn or row["verdict"] == "unexplained"


def summary(rows: Sequence[Row]) -> str:
    """Return the lines of the table, machines apart and together."""
    machines = [*dict.fromkeys(r["machine"] for r in rows)]
    lines = []
    for kind, measures in MEASURES.items():
        for name, hit in measures:
            parts = [[r for r in rows if r["machine"] == m] for m in machines]
            cells = []
            for part in parts:
                own = [hit(r) for r in part if r["kind"] == kind]
                cells.append(f"{sum(own)}/{len(own)}")
            every = [hit(r) for r in rows if r["kind"] == kind]
            lines.append((f"{kind}: {name}", *cells, rate(every)))
    header = ("measure", *machines, "all")
    lines = Table(header, lines).markdown().splitlines()
    for name in machines:
        own = [r for r in rows if r["machine"] == name]
        trials, scored, seconds = (
            np.array([float(r[column]) for r in own])
            for column in ("simulated_trials", "scored_trials", "cpu_seconds")
        )
        lines.append(
            f"\n{name}: {np.median(trials):,.0f} simulated trials and "
            f"{np.median(seconds):.0f} CPU s a verdict in the median, "
            f"{trials.max():,.0f} and {seconds.max():.0f} at most; held-out errors "
            f"take {np.median(scored):,.0f} more"
        )
    return "\n".join(lines)
