"""Falling balls: what gravity alone lacks, from real drops of eleven balls.

``python -m benchmarks measured.ball_drops --data DIR`` compares the simulator of
``sbi_active.tasks.ball_drops`` with the two drops of every ball, writes one row a ball
and one a fold to ``results/ball_drops.json``, and prints the tables. A fold is fitted
to one drop and the first 0.8 s of the other; it chooses its own verdict, and is scored
on the rest. Rows that are there are kept. ``--figures DIR`` draws, and
``--reports DIR`` writes the library's report on each ball.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measured.ball_tables import tables
from benchmarks.measured.fall_least_squares import (
    KINDS,
    forecast_error,
    second_drop_error,
)
from benchmarks.measured.forecast import Forecast, aligned_error, forecast
from sbi_active.criticism import Criticism
from sbi_active.criticism.results import NONE, ModelKey, Tracing
from sbi_active.tasks.ball_drops import (  # pyright: ignore
    DRAG,
    Drop,
    make_effects,
    make_prior,
    make_simulator,
    read_drops,
    trials_of,
)

__all__ = ["judge", "main", "score"]

DATA = Path("../shared/data/ball_drops")
RESULT = Path(__file__).parent / "results" / "ball_drops.json"
UNTIL = 0.8  # s
DRAWN = ("bowling_ball", "blue_basketball", "yellow_whiffle_ball")


def judge(drops: Sequence[Drop], *, seed: int = 0) -> dict[str, Any]:
    """Return what the drops of one ball say of it.

    Args:
        drops: Of one ball.
        seed: Of all draws.
    """
    begin = time.process_time()
    loop = _criticism(trials_of([*drops]), seed)
    detection, tracing = loop.detect(), loop.trace()
    power = loop.rivals.fit(ModelKey(("power-law drag",))).evidence
    linear, quadratic = (
        loop.rivals.fit(ModelKey((name,))).evidence.log_evidence
        for name in ("linear drag", "quadratic drag")
    )
    return {
        "ball": drops[0].ball,
        **_found(tracing),
        "alarm": detection.alarm,
        "log_bayes_factor": detection.log_bayes_factor,
        "robust": tracing.robust,
        "exponent": np.quantile(power.draws[:, -1], [0.05, 0.5, 0.95]).tolist(),
        "linear_over_quadratic": linear - quadratic,
        "cpu_seconds": time.process_time() - begin,
        "simulations": loop.rivals.simulator.num_simulations,
    }


def score(
    fitted: Drop, tested: Drop, *, seed: int = 0
) -> tuple[dict[str, Any], dict[str, Forecast]]:
    """Return the errors on the rest of a drop, and the forecasts.

    Args:
        fitted: Fitted whole.
        tested: Fitted in its first 0.8 s.
        seed: Of all draws.
    """
    begin = time.process_time()
    pair = [fitted, tested]
    loop = _criticism(trials_of(pair, until={1: UNTIL}), seed)
    tracing, whole = loop.trace(), trials_of(pair)
    verdicts = {"before": NONE, "after": tracing.verdict}
    averaged = {"before": {NONE: 1.0}, "after": tracing.probabilities}
    found = {
        when: forecast(loop.rivals, whole, probabilities=p, trial=1, seed=seed)
        for when, p in averaged.items()
    }
    row: dict[str, Any] = {
        "ball": tested.ball,
        "tested": tested.drop,
        **_found(tracing),
    }
    for when, verdict in verdicts.items():
        row |= {
            f"forecast {when}": found[when].rmse,
            f"coverage {when}": found[when].coverage,
            f"second drop {when}": aligned_error(
                loop.rivals, whole, verdict=verdict, trial=1
            ),
        }
    for kind in KINDS:
        row[f"forecast {kind}"] = forecast_error(fitted, tested, kind, until=UNTIL)
        row[f"second drop {kind}"] = second_drop_error(fitted, tested, kind)
    return row | {"cpu_seconds": time.process_time() - begin}, found


def _criticism(trials: Any, seed: int) -> Criticism:
    return Criticism(
        make_simulator(), make_prior(), trials, effects=make_effects(), seed=seed
    )


def _found(tracing: Tracing) -> dict[str, Any]:
    drags = {e.name for e in make_effects() if e.family == DRAG}
    return {
        "verdict": tracing.verdict,
        "probabilities": tracing.probabilities,
        "credible_set": [*tracing.credible_set],
        "probability_of_drag": sum(
            p
            for name, p in tracing.probabilities.items()
            if drags & {*name.split(" + ")}
        ),
    }


def main(
    *,
    data: Path = DATA,
    out: Path = RESULT,
    figures: Path | None = None,
    reports: Path | None = None,
    balls: Sequence[str] | None = None,
    seed: int = 0,
) -> int:
    """Run what is missing from the results, and print the tables.

    Args:
        data: Folder of the measured set.
        out: File of the results.
        figures: Folder for the figures.
        reports: Folder for whole reports.
        balls: Names of balls; all by default.
        seed: Seed of the engine.
    """
    try:
        drops = read_drops(data)
    except FileNotFoundError as error:
        print(f"{error}, as in --data DIR", file=sys.stderr)
        return 2
    rows: dict[str, Any] = {}
    if out.is_file():
        rows = json.loads(out.read_text())
    by_ball: dict[str, list[Drop]] = {}
    for drop in drops:
        by_ball.setdefault(drop.ball, []).append(drop)
    for ball, pair in by_ball.items():
        if balls and ball not in balls:
            continue
        for key in (ball, f"{ball} 1", f"{ball} 2"):
            if key in rows:
                continue
            if key == ball:
                rows[key] = judge(pair, seed=seed)
            else:
                tested = int(key[-1]) - 1
                rows[key], _ = score(pair[1 - tested], pair[tested], seed=seed)
            out.parent.mkdir(parents=True, exist_ok=True)
            out.write_text(json.dumps(rows, indent=1) + "\n")
    print(tables([*rows.values()]))
    if figures is not None:
        _draw(rows, by_ball, figures, seed=seed)
    if reports is not None:
        for ball in balls or by_ball:
            loop = _criticism(trials_of(by_ball[ball]), seed)
            print(loop.report(evaluate=False).save(reports / ball))
    return 0


def _draw(
    rows: dict[str, Any], by_ball: dict[str, list[Drop]], folder: Path, *, seed: int
) -> None:
    from benchmarks.measured.ball_figures import draw_exponents, draw_forecasts

    folder.mkdir(parents=True, exist_ok=True)
    judged = [row for row in rows.values() if "alarm" in row]
    draw_exponents(judged, folder / "exponents.png")
    pairs = {ball.replace("_", " "): by_ball[ball] for ball in DRAWN if ball in by_ball}
    draw_forecasts(
        {name: score(one, two, seed=seed)[1] for name, (one, two) in pairs.items()},
        {name: two for name, (_, two) in pairs.items()},
        folder / "forecasts.png",
        until=UNTIL,
    )
