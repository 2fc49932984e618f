"""The measures of verdicts when every model is wrong, with binomial intervals."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import permutations
from typing import Any

import numpy as np

from benchmarks.criticism.intervals import rate
from benchmarks.misfit.machines import get_machine
from sbi_active.display.table import Table

Row = Mapping[str, str]
#: Gains of the true effect, 1 - held-out error with it / without.
LARGE, SOME = 0.5, 0.2
MATTERS = 0.9  # error of a pair to that of its better member, from which both matter


def summary(rows: Sequence[Row]) -> list[str]:
    """Return the lines of the summary.

    Args:
        rows: Of all kinds, as the CSV files have them.
    """
    failed = [r for r in rows if r.get("failure")]
    rows = [r for r in rows if not r.get("failure")]
    lines = [f"{len(rows)} cases, {len(failed)} failed"]
    lines += [f"failed {r['kind']} {r['case']}: {r['failure']}" for r in failed]
    if not rows:
        return lines
    groups = _groups(rows)
    cells = [
        (name, *(rate([hit(r, column) for r in own]) for column in ("named", "helps")))
        for name, (own, hit) in _measures(groups).items()
    ]
    lines += ["", Table(("measure", "named", "helps"), cells).markdown()]
    lines += ["", _places(rows), _lost_pairs(groups.get("P matters", []))]
    lines += ["", *_coverage(groups), "", *_harm(rows)]
    return [*lines, "", *_cost(rows)]


def _groups(rows: Sequence[Row]) -> dict[str, list[Row]]:
    found: dict[str, list[Row]] = {}
    for r in rows:
        found.setdefault(r["kind"], []).append(r)
        if r["kind"] == "E":
            gain = 1 - float(r["held_true"]) / float(r["held_bare"])
            part = "large" if gain >= LARGE else "some" if gain >= SOME else "little"
            found.setdefault(f"E {part}", []).append(r)
        if r["kind"] == "P":
            ratio = float(r["held_true"]) / float(r["held_single"])
            if ratio < MATTERS:
                found.setdefault("P matters", []).append(r)
    return found


def _measures(
    groups: Mapping[str, list[Row]],
) -> dict[str, tuple[list[Row], Callable[[Row, str], bool]]]:
    def of(name: str) -> list[Row]:
        return groups.get(name, [])

    found = {
        "E, gain >= 50 %: right": (of("E large"), _has_all),
        "E, gain >= 50 %: right, or in a stated place": (
            of("E large"),
            _has_all_places,
        ),
        "E, gain 20 to 50 %: right": (of("E some"), _has_all),
        "E, gain < 20 %: right": (of("E little"), _has_all),
    }
    found |= {f"{k}: a wrong name": (of(k), _has_wrong) for k in ("E", "P")}
    found |= {f"{k}: any name": (of(k), _has_wrong) for k in ("R", "M", "C")}
    return found | {
        "CE: right": (of("CE"), _has_all),
        "CE: a wrong name": (of("CE"), _has_wrong),
        "P, where both matter: both": (of("P matters"), _has_all),
        "P, where both matter: both, or in a stated place": (
            of("P matters"),
            _has_all_places,
        ),
    }


def _said(row: Row, column: str) -> set[str]:
    """Return the effects that are named as a cause, or said to help."""
    return {*json.loads(row[column])}


def _true(row: Row) -> set[str]:
    """Return the names that are right; none where the effect was removed."""
    return set() if row["kind"] == "R" else {*json.loads(row["equivalent"])}


def _has_all(row: Row, column: str) -> bool:
    return _has_all_in(row, [{name} for name in _said(row, column)])


def _has_all_places(row: Row, column: str) -> bool:
    """Return whether the true effects are said, or said to be possible in a place."""
    instead = json.loads(row["instead"])
    return _has_all_in(
        row, [{name, *instead.get(name, ())} for name in _said(row, column)]
    )


def _has_all_in(row: Row, places: Sequence[set[str]]) -> bool:
    """Return whether each true effect, or an equivalent one, has a place of its own."""
    wanted = _alike(row["machine"], row["true"])
    return any(
        all(names & place for names, place in zip(wanted, some, strict=True))
        for some in permutations(places, len(wanted))
    )


@lru_cache
def _alike(machine: str, true: str) -> list[frozenset[str]]:
    """Return the effects that nothing separates from each true one, itself among them.

    Args:
        machine: Its name.
        true: The names of the true effects, as a row has them.
    """
    equivalent = get_machine(machine).equivalent
    return [frozenset(equivalent(name)) for name in json.loads(true)]


def _has_wrong(row: Row, column: str) -> bool:
    return bool(_said(row, column) - _true(row))


def _places(rows: Sequence[Row]) -> str:
    """Return how many effects are said to be possible in the place of another."""
    others = [
        len(json.loads(row["instead"]).get(name, ()))
        for row in rows
        for name in json.loads(row["helps"])
    ]
    mean = f"{np.mean(others):.2f}" if others else "-"
    none = rate([n == 0 for n in others])
    return (
        f"effects that may stand in the place of one that helps: mean {mean}, none for "
        f"{none}"
    )


def _lost_pairs(rows: Sequence[Row]) -> str:
    """Return what prediction loses where one of two effects is not said to help."""
    lost = [r for r in rows if not _has_all(r, "helps")]
    if not lost:
        return "P, where both matter: both are always said to help"
    ratio = np.array([float(r["held_verdict"]) / float(r["held_true"]) for r in lost])
    return (
        "P, where both matter and one is not said to help: held-out error of the "
        f"verdict over that of both: median {np.median(ratio):.2f}, at most 1.1 in "
        f"{rate(ratio <= 1.1)}"
    )


def _coverage(groups: Mapping[str, list[Row]]) -> list[str]:
    """Return how often intervals of theta and phi hold the truth.

    What depends on the state, a form, is what declared effects can imitate.
    """
    hidden, other = (
        [r for kind in kinds for r in groups.get(kind, [])]
        for kinds in (("M", "E", "P"), ("C", "CE"))
    )
    parts = {
        "with misfit": hidden,
        "without": other,
        "beside a form": [r for r in hidden if r["discrepancy"] == "form"],
        "beside any other": [r for r in hidden if r["discrepancy"] != "form"],
    }
    lines = []
    for title, rows in parts.items():
        for what in ("theta", "phi"):
            cells = [c for r in rows if (c := r.get(f"{what}_covered"))]
            pairs = [tuple(map(int, cell.split("/"))) for cell in cells]
            hits = [i < k for k, n in pairs for i in range(n)]
            lines.append(f"90 % intervals of {what} {title}: {rate(hits)}")
    return lines


def _harm(rows: Sequence[Row]) -> list[str]:
    """Return what wrong effects do to the error on held-out trials."""
    wrong = [r for r in rows if r["kind"] in ("R", "M") and json.loads(r["helps"])]
    ratios = np.array([float(r["held_verdict"]) / float(r["held_bare"]) for r in wrong])
    if not len(ratios):
        return ["no effects in R and M that are said to help"]
    return [
        "held-out error with effects said to help in R and M over bare: median "
        f"{np.median(ratios):.2f}, 90 % quantile {np.quantile(ratios, 0.9):.2f}, "
        f"worse in {rate(ratios > 1)}"
    ]


def _cost(rows: Iterable[Row]) -> list[str]:
    found: dict[str, list[Any]] = {}
    for r in rows:
        figures = float(r["trial_simulations"]), float(r["cpu_seconds"])
        found.setdefault(r["machine"], []).append(figures)
    header = ("machine", "cases", "simulated trials, median", "largest")
    lines = []
    for machine, figures in found.items():
        trials, seconds = np.array(figures).T
        sizes = f"{np.median(trials):,.0f}", f"{trials.max():,.0f}"
        lines.append((machine, len(figures), *sizes, f"{np.median(seconds):.0f}"))
    return [Table((*header, "CPU s, median"), lines).markdown()]
