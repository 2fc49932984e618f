"""The servo pendulum: what a motor without friction lacks, from recorded trials.

``python -m benchmarks measured.servo_pendulum --data DIR`` compares the simulator of
``sbi_active.tasks.servo_pendulum`` with the recorded trials in stages, adds each to
``results/servo_pendulum.json`` unless it is there, and prints the tables. Stages:

- ``powered``: all trials in which the motor stays on. What they cannot tell, and the
  trial to make next.
- ``motor off``: that trial as well, the other three motor-off trials held out; beside
  it plain least squares given the effect, on the same split.
- ``powered, iid`` and ``motor off, iid``: the same with independent errors forced.
- ``clean 0``, ``clean 1``, ...: ``--replay clean`` simulates the trials of ``motor
  off`` without friction, at the bare model's least-squares parameters, with errors of
  the size and correlation that are left in the recordings with the effect found.

``--fit 0 2`` judges these trials alone, and ``--figures DIR`` draws.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from benchmarks.measured.servo_least_squares import FRICTIONS, Fit, fit
from benchmarks.measured.servo_rates import RATES, by_rate
from benchmarks.measured.servo_tables import tables
from sbi_active.criticism import Criticism
from sbi_active.criticism.results import NONE, SCATTER, UNEXPLAINED, ModelKey, Tracing
from sbi_active.criticism.steps import predict
from sbi_active.simulation import AutocorrelatedNoise
from sbi_active.tasks.servo_pendulum import ServoPendulumTask  # pyright: ignore
from sbi_active.tasks.servo_pendulum.noise import servo_noise  # pyright: ignore
from sbi_active.tasks.servo_pendulum.task import DATA  # pyright: ignore

__all__ = ["judge", "main", "simulated"]

RESULT = Path(__file__).parent / "results" / "servo_pendulum.json"
NUM_CLEAN = 3
QUANTUM = 2 * np.pi / 4096  # rad, of the encoder
CATCH_ALLS = (NONE, UNEXPLAINED, SCATTER)


def judge(
    task: ServoPendulumTask,
    fitted: Sequence[int],
    held_out: Sequence[int] = (),
    *,
    seed: int = 0,
    folder: Path | None = None,
) -> dict[str, Any]:
    """Return what some recorded trials say.

    Args:
        task: Holds the recordings.
        fitted: Rows that are fitted.
        held_out: Rows that are only scored.
        seed: Of all draws.
        folder: Where the whole report goes.
    """
    begin = time.process_time()
    trials = task.trials(fitted, held_out)
    loop = Criticism(
        task.simulator,
        task.prior,
        trials,
        effects=task.effects(),
        actions=task.actions,
        seed=seed,
    )
    report = loop.report(evaluate=len(held_out) > 0)
    if folder is not None:
        report.save(folder)
    tracing, detection = loop.trace(), loop.detect()
    row: dict[str, Any] = {
        "fitted": [*fitted],
        "held_out": [*held_out],
        "verdict": tracing.verdict,
        "model": tracing.model,
        "cause": {} if tracing.misfit is None else dict(tracing.misfit.cause),
        "alarm": detection.alarm,
        "log_bayes_factor": detection.log_bayes_factor,
        "robust": tracing.robust,
        "probabilities": tracing.probabilities,
        "credible_set": [*tracing.credible_set],
        "near": [sorted(group) for group in tracing.near],
        "log_evidence": {k: e.log_evidence for k, e in tracing.evidences.items()},
        "parameters": {name: _summary(tracing, name) for name in {NONE, tracing.model}},
        "singles": {n: _summary(tracing, n) for n in loop.rivals.effects},
        "warnings": [*report.warnings],
        "seconds": time.process_time() - begin,
        "simulations": loop.rivals.simulator.num_simulations,
    }
    chosen = report.next_action
    if chosen is not None:
        row["gain"] = chosen.information_gain.tolist()
        row["next"] = None
        if chosen.action is not None:
            row["next"] = int(task.find(torch.from_numpy(chosen.action)[None])[0])
    if held_out:
        assert report.evaluation is not None
        row["before_after"] = report.before_after.to_dict("list")
        row["rmse"] = {
            "before": report.evaluation.before["rmse"].tolist(),
            "after": report.evaluation.after["rmse"].tolist(),
        }
        row["draws"] = _predicted(loop, trials.held_out)
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
        rows: Trials that they are taken from.
        seed: Of the errors.
    """
    r = task.recordings
    left = full.residual[[*rows]]
    sd = float(np.sqrt((left**2).mean()))
    rho = float((left[:, 1:] * left[:, :-1]).mean() / (left[:, :-1] ** 2).mean())
    tau = float(r.times[1] - r.times[0]) / -np.log(np.clip(rho, 1e-3, 0.999))
    theta = torch.from_numpy(bare.parameters)[None].expand(len(r), -1)
    mean = task.angles(theta, torch.from_numpy(r.action))
    seeds = torch.arange(len(r)) + 1_000 * seed
    x = AutocorrelatedNoise(sd, tau).sample(
        mean, seeds, times=torch.from_numpy(r.times)
    )
    angle = np.round(x.numpy() / QUANTUM) * QUANTUM
    return ServoPendulumTask(data=replace(r, angle=angle), noise=task.noise)


def _summary(tracing: Tracing, name: str) -> dict[str, list[float]]:
    """Return mean and standard deviation of each parameter of a model."""
    if name not in tracing.evidences:
        return {}
    e = tracing.evidences[name]
    return {
        n: [float(z.mean()), float(z.std())]
        for n, z in zip(e.names, e.draws.T, strict=True)
    }


def _predicted(loop: Criticism, held_out: Any) -> dict[str, Any]:
    """Return mean predictions of held-out trials, and the RMSE of posterior draws."""
    found: dict[str, Any] = {}
    tracing = loop.trace()
    x = held_out.x.numpy()
    kinds = {"before": ModelKey(), "after": tracing.key}
    for when, key in kinds.items():
        p = predict(loop.rivals, held_out, key=key)
        mean = p.mean.reshape(len(p.mean), *x.shape)
        rmse = np.sqrt(((mean - x) ** 2).mean((1, 2)))
        found[when] = {
            "mean": mean.mean(0).tolist(),
            "rmse": np.quantile(rmse, [0.05, 0.5, 0.95]).tolist(),
        }
    return found


def _least_squares(
    task: ServoPendulumTask, row: dict[str, Any], seed: int
) -> dict[str, Any]:
    """Return training and held-out RMSE of plain fits on the split of a stage."""
    sets = [(), *((name,) for name in FRICTIONS)]
    if row["model"] not in (NONE, *CATCH_ALLS):
        sets.append((*row["model"].split(" + "),))
    found = {}
    for names in dict.fromkeys(sets):
        one = fit(task, row["fitted"], names, seed=seed)
        found[" + ".join(names) or NONE] = {
            "parameters": one.parameters.tolist(),
            "train": one.rmse(row["fitted"]),
            "held_out": one.rmse(row["held_out"]),
            "each": [one.rmse([i]) for i in row["held_out"]],
        }
    return found


def _chosen(row: dict[str, Any], off: Sequence[int]) -> int:
    """Return the motor-off trial that a stage asks for, or would ask for first."""
    if row.get("next") in off:
        return int(row["next"])
    return int(off[int(np.argmax(np.array(row["gain"])[[*off]]))])


@dataclass(frozen=True)
class Settings:
    """What is run.

    Args:
        data: Folder of the measured set.
        replay: Sets to replay.
        clean: Number of clean sets.
        fit: Numbers of the trials to fit alone.
        out: File of the results.
        reports: Folder for whole reports.
        figures: Folder for the figures.
        seed: Seed of the engine.
    """

    data: Path = DATA
    replay: Literal["recorded", "clean"] = "recorded"
    clean: int = NUM_CLEAN
    fit: Sequence[int] | None = None
    out: Path = RESULT
    reports: Path | None = None
    figures: Path | None = None
    seed: int = 0


def main(arguments: Settings) -> int:
    """Run the stages that are missing from the results, and print the tables."""
    try:
        task = ServoPendulumTask(data=arguments.data)
    except FileNotFoundError as error:
        print(f"{error}, as in --data DIR", file=sys.stderr)
        return 2
    rows: dict[str, Any] = {}
    if arguments.out.is_file():
        rows = json.loads(arguments.out.read_text())
    for name, row in _stages(task, rows, arguments):
        rows[name] = row
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps(rows, indent=1) + "\n")
        print(f"{name}: {row['verdict']}, {row['seconds']:.0f} CPU s", flush=True)
    print(tables(rows, task.recordings))
    if arguments.figures is not None:
        from benchmarks.measured.servo_figures import draw

        draw(rows, task.recordings, arguments.figures)
    return 0


def _stages(task: ServoPendulumTask, rows: dict[str, Any], arguments: Any) -> Any:
    """Yield the name and the row of each stage that is missing."""
    seed = arguments.seed
    off = np.flatnonzero(task.recordings.motor_off).tolist()
    on = [i for i in range(len(task.recordings)) if i not in off]

    def run(name: str, *parts: Any) -> dict[str, Any]:
        folder = arguments.reports and arguments.reports / name.replace(", ", "_")
        rows[name] = judge(*parts, seed=seed, folder=folder)
        return rows[name]

    if arguments.fit:
        name = f"trials {', '.join(map(str, arguments.fit))}"
        yield name, run(name, task, arguments.fit)
        return
    if "powered" not in rows:
        yield "powered", run("powered", task, on)
    extra = _chosen(rows["powered"], off)
    held = [i for i in off if i != extra]
    split = [*on, extra]
    if "motor off" not in rows:
        yield "motor off", run("motor off", task, split, held)
    row = rows["motor off"]
    if "least squares" not in row:
        row["least squares"] = _least_squares(task, row, seed)
        yield "motor off", row
    if "rates" not in row:
        fine = ServoPendulumTask(data=arguments.data, rate=RATES[0])
        fits = {k: f["parameters"] for k, f in row["least squares"].items()}
        row["rates"] = by_rate(fine, on, fits)
        yield "motor off", row
    if arguments.replay == "clean":
        model = rows["motor off"]["model"]
        names = () if model in (NONE, *CATCH_ALLS) else (*model.split(" + "),)
        wanted = [i for i in range(arguments.clean) if f"clean {i}" not in rows]
        if wanted:
            bare, full = fit(task, split, seed=seed), fit(task, split, names, seed=seed)
            for i in wanted:
                clean = simulated(task, bare, full, split, seed=i)
                yield f"clean {i}", run(f"clean {i}", clean, split, held)
        return
    iid = ServoPendulumTask(data=task.recordings, noise=servo_noise(correlated=False))
    for name, parts in (
        ("powered, iid", (on, ())),
        ("motor off, iid", (split, held)),
    ):
        if name not in rows:
            yield name, run(name, iid, *parts)
