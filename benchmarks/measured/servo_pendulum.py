"""The servo pendulum: what a motor without friction lacks, from recorded trials.

``python -m benchmarks measured.servo_pendulum --data DIR`` compares the simulator of
``sbi_active.tasks.servo_pendulum`` with the recorded trials in stages, adds each to
``results/servo_pendulum.json`` unless it is there, and prints the tables. Stages:

- ``powered``: all trials in which the motor stays on. What they cannot tell, and the
  trial to make next.
- ``motor off``: that trial as well, the other three motor-off trials held out; beside
  it plain least squares given the effect, on the same split.
- ``clean 0``, ``clean 1``, ...: ``--replay clean`` simulates the trials of ``motor
  off`` without friction, at the bare model's least-squares parameters, with errors of
  the size and correlation that are left in the recordings with the effect found.

Rows of independent errors, forced, are of an earlier version.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.fitting import best_in_box
from benchmarks.measured.record_stages import read_report, spreads
from benchmarks.rows import add, measured, stages
from benchmarks.table import shown
from sbi_active.criticism import Criticism
from sbi_active.criticism.results import NONE, SCATTER, UNEXPLAINED
from sbi_active.simulation import AutocorrelatedNoise
from sbi_active.tasks.servo_pendulum import ServoPendulumTask  # pyright: ignore
from sbi_active.tasks.servo_pendulum.model import PRIOR_HIGH, PRIOR_LOW, angles  # pyright: ignore
from sbi_active.tasks.servo_pendulum.task import DATA  # pyright: ignore

Array = NDArray[Any]
Row = dict[str, Any]
RESULT = Path(__file__).parent / "results" / "servo_pendulum.json"
NUM_CLEAN = 3
QUANTUM = 2 * np.pi / 4096  # rad, of the encoder
CATCH_ALLS = (NONE, UNEXPLAINED, SCATTER)
#: Keyword of the simulator and largest strength, by the name of the effect.
FRICTIONS = {
    "Coulomb": ("coulomb", 0.3),
    "load-dependent": ("load", 1.0),
    "torque-dependent": ("torque", 1.0),
    "viscous": ("viscous", 0.1),
}


@dataclass(frozen=True)
class Fit:
    """A least-squares fit to some recorded trials.

    Attributes:
        parameters: Theta and the strengths.
        residual: Recorded minus predicted angles of all trials, rad, shape (t, k).
    """

    parameters: Array
    residual: Array

    def rmse(self, trials: Sequence[int]) -> float:
        """Return the root mean square over some trials, rad."""
        return float(np.sqrt((self.residual[[*trials]] ** 2).mean()))


def fit(
    task: ServoPendulumTask, trials: Sequence[int], names: Sequence[str] = ()
) -> Fit:
    """Return the least-squares fit of the simulator with some effects.

    Args:
        task: Task that holds the recordings.
        trials: Numbers of the trials that are fitted.
        names: Names of the effects.
    """
    r, num = task.recordings, len(task.recordings)

    def residual(z: Array, rows: Sequence[int]) -> Array:
        each = np.repeat(z, len(rows), axis=0)
        friction = {FRICTIONS[n][0]: each[:, 5 + j] for j, n in enumerate(names)}
        x = angles(
            *(each[:, :5], r.kp, r.goal, r.enabled, r.start),
            np.tile([*rows], len(z)),
            every=r.every,
            **friction,
        )
        return r.angle[[*rows]] - x.reshape(len(z), len(rows), -1)

    z, _ = best_in_box(
        lambda z: residual(z, trials).reshape(len(z), -1),
        np.array([*PRIOR_LOW, *[0.0 for _ in names]]),
        np.array([*PRIOR_HIGH, *[FRICTIONS[n][1] for n in names]]),
        starts=4,
        evaluations=30,
        difference=1e-5,
    )
    return Fit(z, residual(z[None], range(num))[0])


def judge(
    task: ServoPendulumTask, fitted: Sequence[int], held_out: Sequence[int] = ()
) -> Row:
    """Return what some recorded trials say.

    Args:
        task: Task that holds the recordings.
        fitted: Numbers of the trials that are fitted.
        held_out: Numbers of the trials that are only scored.
    """
    begin = time.process_time()
    given = task.simulator, task.prior, task.trials(fitted, held_out)
    own = {"effects": task.effects(), "actions": task.actions, "seed": 0}
    loop = Criticism(*given, **own)
    report = loop.report(evaluate=len(held_out) > 0)
    evidences, model = report.tracing.evidences, report.tracing.model
    row = read_report(report) | {
        "fitted": [*fitted],
        "held_out": [*held_out],
        "model": model,
        "parameters": {
            name: spreads(evidences[name])
            for name in {NONE, model, *loop.rivals.effects}
            if name in evidences
        },
        "seconds": time.process_time() - begin,
        "simulations": loop.rivals.simulator.num_simulations,
    }
    if (chosen := report.next_action) is not None:
        row |= {"gain": chosen.information_gain.tolist(), "next": None}
        if chosen.action is not None:
            row["next"] = int(task.find(torch.from_numpy(chosen.action)[None])[0])
    if held_out:
        assert report.evaluation is not None
        row["before_after"] = report.before_after.to_dict("list")
        row["rmse"] = {
            "before": report.evaluation.before["rmse"].tolist(),
            "after": report.evaluation.after["rmse"].tolist(),
        }
    return row


def simulated(
    task: ServoPendulumTask, bare: Fit, full: Fit, rows: Sequence[int], *, seed: int
) -> ServoPendulumTask:
    """Return a task whose recordings are simulations without friction.

    Args:
        task: The recorded one.
        bare: Fit without friction, whose parameters are simulated.
        full: Fit with the effect found, whose residuals give the size and the
            correlation of the errors.
        rows: Numbers of the trials that they are taken from.
        seed: Seed of the errors.
    """
    r = task.recordings
    left = full.residual[[*rows]]
    sd = float(np.sqrt((left**2).mean()))
    rho = float((left[:, 1:] * left[:, :-1]).mean() / (left[:, :-1] ** 2).mean())
    tau = float(r.times[1] - r.times[0]) / -np.log(np.clip(rho, 1e-3, 0.999))
    theta = torch.from_numpy(bare.parameters)[None].expand(len(r), -1)
    mean = task.angles(theta, torch.from_numpy(r.action))
    seeds = torch.arange(len(r)) + 1_000 * seed
    noise = AutocorrelatedNoise(sd, tau).at(torch.from_numpy(r.times))
    x = noise.sample(mean, seeds)
    angle = np.round(x.numpy() / QUANTUM) * QUANTUM
    return ServoPendulumTask(data=replace(r, angle=angle), noise=task.noise)


def least_squares(task: ServoPendulumTask, row: Row) -> Row:
    """Return training and held-out RMSE of plain fits on the split of a stage."""
    sets = [(), *((name,) for name in FRICTIONS), named(row)]
    found = {}
    for names in dict.fromkeys(sets):
        one = fit(task, row["fitted"], names)
        found[" + ".join(names) or NONE] = {
            "parameters": one.parameters.tolist(),
            "train": one.rmse(row["fitted"]),
            "held_out": one.rmse(row["held_out"]),
            "each": [one.rmse([i]) for i in row["held_out"]],
        }
    return found


def named(row: Row) -> tuple[str, ...]:
    """Return the effects of a row's model."""
    return () if row["model"] in CATCH_ALLS else (*row["model"].split(" + "),)


def next_of(row: Row, off: Sequence[int]) -> int:
    """Return the motor-off trial that a stage asks for, or would ask for first."""
    if row.get("next") in off:
        return int(row["next"])
    return int(off[int(np.argmax(np.array(row["gain"])[[*off]]))])


def missing(
    task: ServoPendulumTask, rows: dict[str, Row], num_clean: int
) -> Iterator[tuple[str, Row]]:
    """Yield the name and the row of each stage that is missing."""
    off = np.flatnonzero(task.recordings.motor_off).tolist()
    on = [i for i in range(len(task.recordings)) if i not in off]

    if "powered" not in rows:
        yield "powered", judge(task, on)
    extra = next_of(rows["powered"], off)
    split, held = [*on, extra], [i for i in off if i != extra]
    if "motor off" not in rows:
        yield "motor off", judge(task, split, held)
    row = rows["motor off"]
    if "least squares" not in row:
        yield "motor off", row | {"least squares": least_squares(task, row)}
    wanted = [i for i in range(num_clean) if f"clean {i}" not in rows]
    if wanted:
        bare, full = (fit(task, split, n) for n in ((), named(row)))
        for i in wanted:
            clean = simulated(task, bare, full, split, seed=i)
            yield f"clean {i}", judge(clean, split, held)


def main(
    *, data: Path = DATA, replay: Literal["recorded", "clean"] = "recorded"
) -> None:
    """Run the stages that are missing from the results, and print the tables.

    Args:
        data: Folder of the measured set.
        replay: Kind of the sets.
    """
    task = measured(lambda: ServoPendulumTask(data=data))
    rows = stages(RESULT)
    for name, row in missing(task, rows, NUM_CLEAN if replay == "clean" else 0):
        add(RESULT, rows, name, row)
    figures = ("verdict", "helps", "support", "next", "rmse", "least squares")
    print(shown(RESULT, *(f"*, {name}*" for name in figures), "*seconds"))
