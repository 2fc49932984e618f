"""What tells a cause from an effect that imitates what nobody declared.

    python -m benchmarks misfit.odds --group own --kind E --first 700 --cases 10
    python -m benchmarks misfit.odds --summary

Each effect that a verdict says helps is a claim, with the factors of its odds
(:class:`sbi_active.criticism.under_misfit.Odds`) and whether it is there. The table
fits logistic regressions to the claims of all machines but one, and says how well they
do on that one: by each factor, without each, and by all; beside them the odds as they
are. Cases from 1,000 on judge, and are refused.

Resumable: a case that stands in ``results/odds.csv`` is not run again; cases in which
nothing helps leave a row without an effect.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import brier_score_loss, roc_auc_score
from sklearn.model_selection import LeaveOneGroupOut, cross_val_predict
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from benchmarks.misfit.cases import FIRST_JUDGED, Kind, draw_case
from benchmarks.misfit.machines import GROUPS
from benchmarks.rows import append, read
from sbi_active.criticism import close_loop
from sbi_active.criticism.under_misfit import Odds
from sbi_active.display.table import Table

__all__ = ["COLUMNS", "claims", "main", "table"]

RESULT = Path(__file__).parent / "results" / "odds.csv"
COLUMNS = [
    *["group", "machine", "kind", "case", "effect", "right", "cause"],
    *["declared", "helping", "at_bounds", "gained", "remains", "error", "timed"],
    "guessed",
]

Row = Mapping[str, Any]


def claims(group: str, kind: Kind, number: int) -> list[Row]:
    """Return a row for each effect that helps, or one without any."""
    case = draw_case(group, kind, number)
    problem, truth = case.problem, case.truth
    report = close_loop(
        problem.model,
        problem.prior,
        problem.trials,
        effects=problem.effects,
        seed=number,
        evaluate=False,
        plan=False,
    )
    known = {
        "group": group,
        "machine": truth.machine.name,
        "kind": kind,
        "case": number,
    }
    misfit = report.tracing.misfit
    if misfit is None or not misfit.helps:
        return [known]
    alike = [truth.machine.equivalent(name) for name in truth.names]
    right = frozenset() if kind == "R" else frozenset().union(*alike)
    return [
        known
        | {"effect": name, "right": int(name in right), "cause": misfit.cause[name]}
        | {k: value for k, value in vars(odds).items() if k in COLUMNS}
        for name, odds in misfit.odds.items()
    ]


def table(rows: Sequence[Row]) -> list[str]:
    """Return how well factors of the odds tell causes from imitations.

    Args:
        rows: Claims, as the CSV file has them.
    """
    rows = [row for row in rows if row["effect"]]
    right = np.array([int(row["right"]) for row in rows])
    machines = np.array([row["machine"] for row in rows])
    odds = [_odds(row) for row in rows]
    factors = {  # a hundredth keeps what gains nothing finite
        "nats gained": [np.log(o.by_gain + 0.01) for o in odds],
        "what remains": [np.log1p((o.remains / o.own.remaining) ** 2) for o in odds],
        "error": [np.log1p(o.error / o.own.far) for o in odds],
        "guesses": [
            np.logaddexp(0.0, o.guessed - np.log(o.own.declared)) for o in odds
        ],
        "effects that help": [o.helping for o in odds],
        "parameters at bounds": [o.at_bounds for o in odds],
    }

    def line(title: str, names: Sequence[str]) -> tuple[str, ...]:
        found = _predicted(np.array([factors[n] for n in names]).T, right, machines)
        return title, *_scores(right, found)

    as_they_are = np.array([o.probability for o in odds])
    every = [*factors]
    header = ("by", "area under the curve", "Brier score")
    cells = [
        *(line(name, [name]) for name in every),
        *(line(f"all but {n}", [m for m in every if m != n]) for n in every),
        line("all", every),
        ("the odds as they are", *_scores(right, as_they_are)),
    ]
    return [
        f"{len(rows)} effects that help, {right.sum()} of them there, "
        f"{len({*machines})} machines, each by the others",
        "",
        *Table(header, cells).markdown().splitlines(),
    ]


def _odds(row: Row) -> Odds:
    return Odds(
        declared=int(row["declared"]),
        helping=int(row["helping"]),
        at_bounds=int(row["at_bounds"]),
        gained=float(row["gained"]),
        remains=float(row["remains"]),
        error=float(row["error"]),
        timed=row["timed"] == "True",
        guessed=float(row["guessed"]),
    )


def _predicted(
    x: NDArray[np.float64], right: NDArray[np.int64], groups: NDArray[np.str_]
) -> NDArray[np.float64]:
    """Return the probabilities of a logistic regression on the other groups."""
    model = make_pipeline(StandardScaler(), LogisticRegression())
    found = cross_val_predict(
        model, x, right, groups=groups, cv=LeaveOneGroupOut(), method="predict_proba"
    )
    return np.asarray(found)[:, 1]


def _scores(right: NDArray[np.int64], p: NDArray[np.float64]) -> tuple[str, str]:
    return f"{roc_auc_score(right, p):.3f}", f"{brier_score_loss(right, p):.3f}"


@dataclass(frozen=True)
class Settings:
    """What is run.

    Args:
        group: Group of worlds.
        kind: Kind of cases.
        first: Number of the first case.
        cases: Number of cases.
        out: File of the results.
        summary: Whether to run nothing, and print the table of the rows.
    """

    group: Annotated[str, GROUPS] = "own"
    kind: Kind = "E"
    first: int = 700
    cases: int = 10
    out: Path = RESULT
    summary: bool = False


def main(arguments: Settings) -> None:
    """Run the cases that are asked for and print the table."""
    if not arguments.summary:
        _run(arguments)
    print("\n".join(table(read(arguments.out))))


def _run(arguments: Settings) -> None:
    group, kind = arguments.group, arguments.kind
    numbers = range(arguments.first, arguments.first + arguments.cases)
    if numbers.stop > FIRST_JUDGED:
        raise SystemExit(
            f"expected cases below {FIRST_JUDGED}, since those from there on judge; "
            f"got {numbers.start} to {numbers.stop - 1}; pass another --first"
        )
    done = {(r["group"], r["kind"], int(r["case"])) for r in read(arguments.out)}
    for number in numbers:
        if (group, kind, number) in done:
            continue
        rows = claims(group, kind, number)
        append(arguments.out, COLUMNS, rows)
        said = {
            row["effect"]: round(row["cause"], 2) for row in rows if "effect" in row
        }
        print(f"{group} {kind} {number}: {json.dumps(said)}", flush=True)
