"""What is named when the effect that is there was removed: the servo and the balls.

    python -m benchmarks measured.removals --set servo
    python -m benchmarks measured.removals --set balls
    python -m benchmarks measured.removals --summary

The hoop and the tanks have such stages in their own commands
(:mod:`benchmarks.measured.record_stages`). The servo is judged by its twelve powered
trials, and by them with the motor-off trial that they ask for
(:mod:`benchmarks.measured.servo_pendulum`), each without load-dependent friction and
none, one or two of the other three forms, and once without torque-dependent friction
alone. Of each ball whose drops show drag, or something, all three forms of drag are
removed. An *alias* is an effect that is named then, and not as the nearest
form of a family whose form is said to be open. Each row is added to
``results/removals.json`` unless it is there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

from benchmarks.measured.ball_drops import DATA as BALLS
from benchmarks.measured.ball_drops import jobs_without_drag
from benchmarks.measured.record_stages import causes, reported, said, shares_left
from benchmarks.rows import add, measured, stages
from sbi_active.criticism import Effect
from sbi_active.display.table import Table
from sbi_active.tasks.servo_pendulum import ServoPendulumTask  # pyright: ignore
from sbi_active.tasks.servo_pendulum.task import DATA as SERVO  # pyright: ignore

RESULT = Path(__file__).parent / "results" / "removals.json"
#: The servo's stages, by the name that its rows have here and there.
STAGES = {"servo": "powered", "servo, motor off": "motor off"}
#: Friction that the powered trials of the servo show, and another that helps.
CAUSE, BESIDE = "load-dependent", "torque-dependent"
#: Balls whose verdict with the whole library is a drag, or "unexplained".
DROPPED = (
    "blue_basketball",
    "green_basketball",
    "volleyball",
    "whiffle_ball_1",
    "whiffle_ball_2",
    "yellow_whiffle_ball",
    "orange_whiffle_ball",
    "tennis_ball",
)

Job = tuple[str, str, Any, Any, Any, list[Effect]]


def removed(
    model: Any, prior: Any, trials: Any, effects: Sequence[Effect]
) -> dict[str, Any]:
    """Return what is said of trials with a part of the library.

    Args:
        model: The bare simulator.
        prior: Prior of its parameters.
        trials: Trials to fit.
        effects: What is left of the library, with nuisances.
    """
    _, row = reported(model, prior, trials, effects)
    return row | {"share_said": shares_left(row)}


def _servo(data: Path) -> Iterator[Job]:
    task = ServoPendulumTask(data=data)
    rows = stages(RESULT.with_name("servo_pendulum.json"))
    effects = task.effects()
    others = [e.name for e in effects if e.name != CAUSE]
    sets = [(BESIDE,)]
    for size in range(len(others)):  # not all: nothing would be left to name
        sets += [(CAUSE, *more) for more in combinations(others, size)]
    for which, stage in STAGES.items():
        trials = task.trials(rows[stage]["fitted"])
        for gone in sets:
            left = [e for e in effects if e.name not in gone]
            yield which, " + ".join(gone), task.simulator, task.prior, trials, left


def _balls(data: Path) -> Iterator[Job]:
    for job in jobs_without_drag(data, DROPPED):
        yield "balls", *job


def table(rows: dict[str, dict[str, Any]]) -> str:
    """Return the rows in Markdown, and how many aliases were named in each set."""
    parts = []
    for which, title in (
        ("servo", "servo, from"),
        ("servo, motor off", "servo with a motor-off trial, from"),
        ("balls", "drag, from the"),
    ):
        own = {k: row for k, row in rows.items() if k.startswith(f"{which}: ")}
        if not own:
            continue
        cells = [
            (
                key.removeprefix(f"{which}: ").replace("_", " "),
                *(said(row), causes(row), f"{row['trial_simulations']:,}"),
                f"{row['cpu_seconds']:.0f}",
            )
            for key, row in own.items()
        ]
        header = [f"{title} library", "verdict", "excess left", "simulated trials"]
        real = {CAUSE} if which in STAGES else set()
        alias = [
            row
            for row in own.values()
            if {*row["named"]} - {*row.get("open_forms", {})} - real
        ]
        told = sum(row["share_said"] for row in alias)
        parts += [
            Table([*header, "CPU s"], cells).markdown(),
            f"Aliases named: {len(alias)} of {len(own)} removals; the share left said "
            f"in {told}.",
        ]
    return "\n\n".join(parts)


def main(
    *, set: Literal["servo", "balls"] | None = None, summary: bool = False
) -> None:
    """Run the removals that are missing from the results, and print the tables.

    Args:
        set: Name of the measured set.
        summary: Whether to run nothing, and print the table of the rows.
    """
    rows = stages(RESULT)
    jobs = {"servo": lambda: [*_servo(SERVO)], "balls": lambda: [*_balls(BALLS)]}
    for which, name, *parts in measured(jobs[set]) if set and not summary else ():
        if (key := f"{which}: {name}") not in rows:
            add(RESULT, rows, key, removed(*parts))
    print(table(rows))
