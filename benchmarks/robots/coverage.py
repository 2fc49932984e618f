"""Coverage of 95 % intervals beside those of ``mujoco.sysid``, in logs with a truth.

    python -m benchmarks robots.coverage --machine spring-mass --seeds 2000 2200
    python -m benchmarks robots.coverage --summary [--by-parameter]

Sets are made by :mod:`.machines`: white noise, noise of autocorrelation .9 and .98, and
white noise beside dry friction that the model lacks. On each set, in one process:

- sysid: ``optimize`` and ``calculate_intervals``, as its report prints them;
- ours: ``identify_robot``;
- bare: the same with nothing beside the parameters, as for any simulator, where there
  is friction;
- loop: with ``--loop``, where there is friction: ``close_loop`` with effects of
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
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import torch

from benchmarks.criticism.intervals import wilson
from benchmarks.robots.machines import CONDITIONS, MACHINES, Machine, Set, recorded
from benchmarks.rows import resumed
from sbi_active import GaussianNoise
from sbi_active.criticism import close_loop
from sbi_active.criticism.identification import identify
from sbi_active.mujoco import from_sysid, mjcf_effects
from sbi_active.mujoco.identification import identify_robot
from sbi_active.mujoco.robot import Robot

RESULTS = Path(__file__).parent / "results/coverage.csv"
FIELDS: list[str] = [
    *("machine", "condition", "seed", "way", "parameter", "truth", "low", "high"),
    *("cpu_seconds", "verdict", "warned"),
]
LEVEL, FIRST = 0.95, 2000
#: Effects among which the loop looks.
LIBRARY = ("* friction loss", "* quadratic damping", "* quadratic stiffness")

Intervals = dict[str, tuple[float, float]]


def by_sysid(own: Set) -> tuple[Intervals, str, str]:
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
    return {n: (float(v - h), float(v + h)) for n, v, h in each}, "", ""


def by_us(own: Set, seed: int, *, bare: bool = False) -> tuple[Intervals, str, str]:
    """Return our intervals."""
    robot = from_sysid(own.sequences, own.params)
    belief = identify_robot(robot, beside=() if bare else None, seed=seed)
    return belief.interval(LEVEL), "", " | ".join(belief.diagnostics.warnings)


def by_loop(own: Set, seed: int) -> tuple[Intervals, str, str]:
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
    words = " | ".join(belief.diagnostics.warnings)
    return {name: every[name] for name in names}, report.verdict, words


def rows_of(machine: str, condition: str, seed: int, way: str) -> list[dict[str, Any]]:
    """Return the rows of one set by one way, a parameter each."""
    own = recorded(MACHINES[machine], condition, seed)
    start = time.process_time()
    if way == "sysid":
        found, verdict, words = by_sysid(own)
    elif way == "loop":
        found, verdict, words = by_loop(own, seed)
    else:
        found, verdict, words = by_us(own, seed, bare=way == "bare")
    spent = round(time.process_time() - start, 3)
    return [
        dict(
            zip(
                FIELDS,
                (machine, condition, seed, way, name, truth, *ends, spent)
                + (verdict, words),
                strict=True,
            )
        )
        for (name, ends), truth in zip(found.items(), own.truth, strict=True)
    ]


def jobs_of(options: Settings) -> Iterator[tuple[str, str, int, str]]:
    """Yield sets and ways; where there is friction, two more ways."""
    for seed in range(*options.seeds):
        for condition in options.conditions:
            rough = ["bare", "loop"][: 1 + options.loop]
            more = rough if condition.startswith("friction") else []
            for way in ("sysid", "ours", *more):
                yield options.machine, condition, seed, way


def table(rows: Any) -> pd.DataFrame:
    """Return coverage with its 95 % interval, widths and cost, by way.

    Args:
        rows: As they are written.
    """
    found = []
    keys = ["machine", "condition", "way"]
    for key, own in rows.groupby(keys, sort=False):
        inside = (own.low <= own.truth) & (own.truth <= own.high)
        width = (own.high - own.low) / 2
        each = []
        for name in own.parameter.unique():
            some = own.parameter == name
            each.append(
                f"{name} {inside[some].mean():.2f} ({width[some].median():.2g})"
            )
        cpu = own.drop_duplicates("seed").cpu_seconds
        low, high = wilson(int(inside.sum()), len(inside))
        found.append(
            dict(zip(keys, key, strict=True))
            | {
                "sets": own.seed.nunique(),
                "coverage": f"{inside.mean():.2f} ({low:.2f} to {high:.2f})",
                "by parameter (median half width)": ", ".join(each),
                "CPU s": f"{cpu.mean():.2f}",
            }
        )
    return pd.DataFrame(found)


def summary(rows: Any) -> pd.DataFrame:
    """Return coverage over all parameters and the cost, one row a condition.

    Args:
        rows: As they are written.
    """
    found = []
    for (machine, condition), own in rows.groupby(["machine", "condition"], sort=False):
        row: dict[str, Any] = {"machine": machine, "condition": condition}
        for way in ("sysid", "ours", "bare", "loop"):
            some = own[own.way == way]
            inside = (some.low <= some.truth) & (some.truth <= some.high)
            row[way] = f"{inside.mean():.2f}" if len(some) else "-"
            if way == "loop" and len(some):
                row[way] += f" ({some.seed.nunique()} sets)"
        ours, theirs = (
            own[own.way == way].drop_duplicates("seed").cpu_seconds.mean()
            for way in ("ours", "sysid")
        )
        row["sets"] = own[own.way == "ours"].seed.nunique()
        row["CPU s, sysid and ours"] = f"{theirs:.1f}, {ours:.1f}"
        found.append(row)
    return pd.DataFrame(found)


def missing(machine: str) -> str:
    """Return why a machine cannot be made here, or ""."""
    try:
        from mujoco import sysid  # pyright: ignore

        if not hasattr(sysid, "optimize"):
            return "needs mujoco.sysid; run pip install 'sbi-active[sysid]'"
        own: Machine = MACHINES[machine]
        own.spec()
    except (ImportError, ValueError, OSError) as error:
        return f"{machine} cannot be made here: {error}"
    return ""


@dataclass(frozen=True)
class Settings:
    """What is run.

    Args:
        summary: Whether to run nothing, and print the table of the rows.
        machine: Name of a machine.
        conditions: Names of the conditions.
        seeds: Seeds, from the first to before the second.
        by_parameter: Whether to print a line a parameter.
        loop: Whether to run the closed loop too.
        out: File of the results.
    """

    summary: bool = False
    machine: Annotated[str, MACHINES] = "spring-mass"
    conditions: Sequence[str] = (*CONDITIONS,)
    seeds: tuple[int, int] = (FIRST, FIRST + 200)
    by_parameter: bool = False
    loop: bool = False
    out: Path = RESULTS


def main(options: Settings) -> None:
    """Run from a shell."""
    if options.summary:
        rows: Any = pd.read_csv(options.out)
        told = table if options.by_parameter else summary
        print(
            told(rows[rows.seed >= FIRST]).to_markdown(
                index=False, disable_numparse=True
            )
        )
        return
    if words := missing(options.machine):
        print(words, file=sys.stderr)
        return
    resumed(options.out, FIELDS[:4], jobs_of(options), rows_of, columns=FIELDS)
