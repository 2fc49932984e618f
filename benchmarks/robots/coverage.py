"""Coverage of 95 % intervals beside those of ``mujoco.sysid``, in logs with a truth.

    python -m benchmarks robots.coverage --machine spring-mass --seeds 2000 2200
    python -m benchmarks robots.coverage --summary

Sets are made by :mod:`.machines`: white noise, noise of autocorrelation .9 and .98, and
white noise beside dry friction that the model lacks. On each set, in one process:

- sysid: ``optimize`` and ``calculate_intervals``, as its report prints them;
- ours: ``identify_robot``;
- bare: the same with nothing beside the parameters, as for any simulator, where there
  is friction;
- loop: where there is friction, ``close_loop`` with effects of
  ``mjcf_effects``, and ``identify`` of the simulator that it gives.

Rows (results/coverage.csv): machine, condition, seed, way, CPU seconds of making and
fitting, verdict of the loop, warnings, and for each parameter truth and interval. Those
that are there are not run again. Choices were made on seeds below 1000; the table is of
seeds from 2000 on. The leg needs ``GO2_IN_AIR``, the path of its MJCF, or the folder of
measured data beside the project; "swimmer" needs gymnasium, whose MJCF it is, and
"reacher" dm_control.
"""

from __future__ import annotations

import contextlib
import copy
import io
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.robots.machines import CONDITIONS, MACHINES, Set, recorded
from benchmarks.rows import benchmark, column, grouped
from sbi_active import GaussianNoise
from sbi_active.criticism import close_loop
from sbi_active.criticism.identification import identify
from sbi_active.display.table import Table
from sbi_active.mujoco import from_sysid, identify_robot, mjcf_effects
from sbi_active.mujoco.robot import Robot

RESULTS = Path(__file__).parent / "results/coverage.csv"
WAYS = ("sysid", "ours", "bare", "loop")
LEVEL = 0.95
#: Effects among which the loop looks.
LIBRARY = ("* friction loss", "* quadratic damping", "* quadratic stiffness")

Intervals = dict[str, tuple[float, float]]


def by_sysid(own: Set) -> Intervals:
    """Return the intervals of ``mujoco.sysid``."""
    from mujoco import sysid  # pyright: ignore

    params = own.params.copy()
    residual = sysid.build_residual_fn(models_sequences=[own.sequences], n_threads=1)
    with contextlib.redirect_stdout(io.StringIO()):
        _, found = sysid.optimize(params, residual, verbose=False)
    x = np.asarray(found.x, dtype=float).ravel()
    left, _, _ = residual(x, params)
    _, half = sysid.calculate_intervals(left, np.asarray(found.jac), alpha=1 - LEVEL)
    names = [name for name in params.keys()]  # noqa: C416, SIM118
    each = zip(names, x, np.asarray(half), strict=True)
    return {n: (float(v - h), float(v + h)) for n, v, h in each}


def by_us(own: Set, seed: int, *, bare: bool = False) -> Intervals:
    """Return our intervals."""
    robot = from_sysid(own.sequences, own.params)
    belief = identify_robot(robot, beside=() if bare else None, seed=seed)
    return belief.interval(LEVEL)


def by_loop(own: Set, seed: int) -> Intervals:
    """Return the intervals beside the effects that the loop finds."""
    robot: Robot = from_sysid(own.sequences, own.params)
    assert robot.trials is not None
    errors = identify_robot(robot, seed=seed).diagnostics.errors
    sd = [e["sd"] * e["white"] ** 0.5 for e in errors.values()]
    noisy = copy.copy(robot.simulator)
    noisy.noise = GaussianNoise(torch.tensor(sd))
    report = close_loop(
        noisy,
        robot.prior,
        robot.trials,
        effects=mjcf_effects(robot, include=LIBRARY),
        evaluate=False,
        plan=False,
        seed=seed,
    )
    belief = identify(report.simulator, report.prior, robot.trials, seed=seed)
    every = belief.interval(LEVEL)
    names = robot.simulator.parameter_names or ()
    return {name: every[name] for name in names}


def rows_of(machine: str, condition: str, seed: int, way: str) -> list[dict[str, Any]]:
    """Return the rows of one set by one way, a parameter each."""
    own = recorded(MACHINES[machine], condition, seed)
    start = time.process_time()
    if way == "sysid":
        found = by_sysid(own)
    elif way == "loop":
        found = by_loop(own, seed)
    else:
        found = by_us(own, seed, bare=way == "bare")
    spent = round(time.process_time() - start, 3)
    return [
        {"parameter": name, "truth": truth, "low": low, "high": high}
        | {"cpu_seconds": spent}
        for (name, (low, high)), truth in zip(found.items(), own.truth, strict=True)
    ]


def summary(rows: list[dict[str, str]]) -> str:
    """Return coverage over all parameters and the cost, one row a condition."""
    cells = []
    for (machine, condition), own in grouped(rows, "machine", "condition").items():
        shares, cpu, sets = [], {}, {}
        for way in WAYS:
            some = [r for r in own if r["way"] == way]
            low, truth, high = (column(some, k) for k in ("low", "truth", "high"))
            share = ((low <= truth) & (truth <= high)).mean() if some else np.nan
            shares.append(f"{share:.2f}" if some else "-")
            by_seed = {r["seed"]: float(r["cpu_seconds"]) for r in some}
            sets[way], cpu[way] = len(by_seed), np.mean([*by_seed.values()] or [np.nan])
        shares[-1] += f" ({sets['loop']} sets)" if sets["loop"] else ""
        seconds = f"{cpu['sysid']:.1f}, {cpu['ours']:.1f}"
        cells.append((machine, condition, *shares, sets["ours"], seconds))
    header = ("machine", "condition", *WAYS, "sets", "CPU s, sysid and ours")
    return Table(header, cells).markdown()


main = benchmark(
    RESULTS,
    rows_of,
    summary,
    skip=lambda machine, condition, seed, way: (
        way in ("bare", "loop") and not condition.startswith("friction")
    ),
    machine=MACHINES,
    condition=CONDITIONS,
    seed=range(2000, 2240),
    way=WAYS,
)
