"""Falling balls: what gravity alone lacks, from real drops of eleven balls.

``python -m benchmarks measured.ball_drops --data DIR`` compares the simulator of
``sbi_active.tasks.ball_drops`` with the two drops of every ball, writes one row a ball
and one a fold to ``results/ball_drops.json``, and prints the tables. A fold is fitted
to one drop and the first 0.8 s of the other; it chooses its own verdict, and is scored
on the rest. Rows that are there are kept.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.measured.ball_forecast import (
    KINDS,
    aligned_error,
    forecast,
    forecast_error,
    second_drop_error,
)
from benchmarks.measured.record_stages import row_of
from benchmarks.rows import add, measured, stages
from sbi_active.criticism import Criticism
from sbi_active.criticism.results import NONE, ModelKey, Tracing
from sbi_active.display.table import Table
from sbi_active.tasks.ball_drops import (  # pyright: ignore
    DRAG,
    Drop,
    make_effects,
    make_prior,
    make_simulator,
    read_drops,
    trials_of,
)

Array = NDArray[Any]
Row = dict[str, Any]
DATA = Path("../shared/data/ball_drops")
RESULT = Path(__file__).parent / "results" / "ball_drops.json"
UNTIL = 0.8  # s
LIKELY = 0.5  # probability of the family of drag from which it is the verdict
NUM_BOOTSTRAP = 4_000
WHEN = ("before", "after")
COLUMNS = (*WHEN, *KINDS)


def judge(drops: Sequence[Drop]) -> Row:
    """Return what the drops of one ball say of it.

    Args:
        drops: Drops of one ball.
    """
    begin = time.process_time()
    loop = criticism(trials_of([*drops]))
    detection, tracing = loop.detect(), loop.trace()
    power, linear, quadratic = (
        loop.rivals.fit(ModelKey((f"{form} drag",))).evidence
        for form in ("power-law", "linear", "quadratic")
    )
    return {
        "ball": drops[0].ball,
        **found(tracing),
        "alarm": detection.alarm,
        "log_bayes_factor": detection.log_bayes_factor,
        "exponent": np.quantile(power.draws[:, -1], [0.05, 0.5, 0.95]).tolist(),
        "linear_over_quadratic": linear.log_evidence - quadratic.log_evidence,
        "cpu_seconds": time.process_time() - begin,
        "simulations": loop.rivals.simulator.num_simulations,
    }


def score(fitted: Drop, tested: Drop) -> Row:
    """Return the errors on the rest of a drop.

    Args:
        fitted: Drop that is fitted whole.
        tested: Drop that is fitted in its first 0.8 s.
    """
    begin = time.process_time()
    pair = [fitted, tested]
    loop = criticism(trials_of(pair, until={1: UNTIL}))
    tracing, whole = loop.trace(), trials_of(pair)
    verdicts = {"before": NONE, "after": tracing.verdict}
    averaged = {"before": {NONE: 1.0}, "after": tracing.probabilities}
    forecasts = {
        when: forecast(loop.rivals, whole, probabilities=p, trial=1)
        for when, p in averaged.items()
    }
    row: Row = {"ball": tested.ball, "tested": tested.drop, **found(tracing)}
    for when, verdict in verdicts.items():
        error = aligned_error(loop.rivals, whole, verdict=verdict, trial=1)
        row |= {
            f"forecast {when}": forecasts[when].rmse,
            f"coverage {when}": forecasts[when].coverage,
            f"second drop {when}": error,
        }
    for kind in KINDS:
        row[f"forecast {kind}"] = forecast_error(fitted, tested, kind, until=UNTIL)
        row[f"second drop {kind}"] = second_drop_error(fitted, tested, kind)
    return row | {"cpu_seconds": time.process_time() - begin}


def criticism(trials: Any) -> Criticism:
    """Return the closed loop on some drops."""
    return Criticism(
        make_simulator(), make_prior(), trials, effects=make_effects(), seed=0
    )


def found(tracing: Tracing) -> Row:
    """Return a verdict, and the probability of any drag."""
    drags = {e.name for e in make_effects() if e.family == DRAG}
    row = row_of(tracing)
    kept = {name: row[name] for name in ("verdict", "probabilities", "credible_set")}
    return kept | {
        "probability_of_drag": sum(
            p
            for name, p in row["probabilities"].items()
            if drags & {*name.split(" + ")}
        )
    }


def main(*, data: Path = DATA) -> None:
    """Run what is missing from the results, and print the tables.

    Args:
        data: Folder of the measured set.
    """
    rows, by_ball = stages(RESULT), {}
    for drop in measured(read_drops, data):
        by_ball.setdefault(drop.ball, []).append(drop)
    for ball, pair in by_ball.items():
        if ball not in rows:
            add(RESULT, rows, ball, judge(pair))
        for k in (0, 1):
            if (key := f"{ball} {k + 1}") not in rows:
                add(RESULT, rows, key, score(pair[1 - k], pair[k]))
    print(tables([*rows.values()]))


def tables(rows: Sequence[Row]) -> str:
    """Return the verdicts a ball, and the errors over all folds, in Markdown.

    Args:
        rows: Rows of ``judge``, with "alarm", and of ``score``.
    """
    balls = [row for row in rows if "alarm" in row]
    folds = [row for row in rows if "tested" in row]
    return "\n\n".join([_verdicts(balls), _errors(folds)])


def called(row: Row) -> str:
    """Return the verdict on a ball, that of the family for a drag."""
    is_drag = row["verdict"] != "none" and row["probability_of_drag"] > LIKELY
    return "drag-like" if is_drag else row["verdict"]


def _verdicts(rows: Sequence[Row]) -> str:
    cells = []
    for row in rows:
        low, middle, high = row["exponent"]
        verdict, exponent, favor = called(row), "", ""
        if verdict == "drag-like":
            exponent = f"{middle:.2f} ({low:.2f} to {high:.2f})"
            favor = f"{row['linear_over_quadratic']:+.1f}"
        odds = f"{row['probability_of_drag']:.2f}", f"{row['log_bayes_factor']:.1f}"
        ball, kept = row["ball"].replace("_", " "), ", ".join(row["credible_set"])
        cells.append((ball, verdict, *odds, kept, exponent, favor))
    header = ["ball", "verdict", "P(drag)", "log BF", "not excluded (90 %)"]
    header += ["exponent, 5 to 95 %", "linear over quadratic, nats"]
    return Table(header, cells).markdown()


def _errors(rows: Sequence[Row]) -> str:
    """Return root mean squares over folds, with intervals over balls."""
    balls = sorted({row["ball"] for row in rows})
    rng = np.random.default_rng(0)
    resampled = rng.integers(len(balls), size=(NUM_BOOTSTRAP, len(balls)))

    def squares(what: str, name: str) -> Array:
        """Return the mean square of each ball."""
        every = [(r["ball"], r[f"{what} {name}"] ** 2) for r in rows]
        return np.array([np.mean([v for b, v in every if b == ball]) for ball in balls])

    def cell(value: float, many: Array) -> str:
        low, high = np.quantile(np.sqrt(many), [0.05, 0.95])
        return f"{np.sqrt(value):.2f} ({low:.2f} to {high:.2f})"

    cells = []
    for what in ("second drop", "forecast"):
        square = {name: squares(what, name) for name in COLUMNS}
        mean = {name: s.mean() for name, s in square.items()}
        many = {name: s[resampled].mean(1) for name, s in square.items()}
        ratio = cell(mean["after"] / mean["before"], many["after"] / many["before"])
        cells.append([what, *(cell(mean[n], many[n]) for n in COLUMNS), ratio])
    cover = [f"{np.mean([row[f'coverage {w}'] for row in rows]):.2f}" for w in WHEN]
    rest = [""] * (len(KINDS) + 1)
    cells.append(["90 % coverage of the forecast", *cover, *rest])
    names = [*WHEN, *(f"{kind}, least squares" for kind in KINDS)]
    header = [f"RMSE, m, {len(rows)} folds", *names, "after / before"]
    return Table(header, cells).markdown()


def jobs_without_drag(data: Path, balls: Sequence[str]) -> Iterator[tuple[Any, ...]]:
    """Yield what is fitted of each ball where no drag is declared.

    Args:
        data: Folder of the measured set.
        balls: Names of balls.
    """
    drops = read_drops(data)
    left = [e for e in make_effects() if e.family != DRAG]
    for ball in balls:
        trials = trials_of([d for d in drops if d.ball == ball])
        yield ball, make_simulator(), make_prior(), trials, left
