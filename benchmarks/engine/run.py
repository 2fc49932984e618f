"""What the engine costs, what a second worker gains, and a night of faults.

    python -m benchmarks engine

Other work on the machine comes and goes, so the variants run in turn, in an order that
is drawn anew for each repetition, and a ratio is the median of the ratios within a
repetition, given with its quartiles. Simulators wait, which a busy machine disturbs
little, or burn CPU time, which is then what is counted where cores are no matter.

Overhead: a simulator of 1 ms a row, in batches, beside a plain loop that calls the same
function on the same batches: the wall time where it waits, and where it burns the CPU
time of this process and all below it. Workers: a simulator of 5 ms a row on one and on
two workers, beside a ``joblib.Parallel`` loop over the same batches; all processes are
started before. Faults: 5 % of the rows raise, 1 % hang, 10 % are NaN and one ends its
process. CPU times are read by psutil, which comes with Dask.
"""

from __future__ import annotations

import os
import signal
import time
import warnings
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from statistics import median, quantiles
from typing import Any

import psutil
import torch
from joblib import Parallel, delayed
from torch import Tensor

from benchmarks.rows import in_turn, keep
from benchmarks.table import leaves
from sbi_active.seeding import row_normals, row_seeds
from sbi_active.simulation import MissingRowsWarning, Workers, simulate

TIME_LIMIT = 0.5  # s


class Timed:
    """A simulator that takes a given time a row, burning the CPU or waiting."""

    def __init__(self, seconds: float, *, burns: bool) -> None:
        self.seconds = seconds
        self.burns = burns

    def __call__(self, theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
        for _ in range(len(theta)):
            if self.burns:
                burn(self.seconds)
            else:
                time.sleep(self.seconds)
        return theta + action + row_normals(seeds, 1).float()


def burn(seconds: float) -> None:
    """Use CPU time, of this thread: a core that is shared gives less of it."""
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


class Faulty:
    """theta is the row: each knows from it what goes wrong."""

    def __call__(self, theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
        x = theta + row_normals(seeds, 1).float()
        for i, row in enumerate(theta[:, 0].long().tolist()):
            if row == 1_234:
                os.kill(os.getpid(), signal.SIGKILL)
            if row % 20 == 3:
                raise RuntimeError(f"row {row} raised")
            if row % 100 == 57:
                time.sleep(3600)
            if row % 10 == 5:
                x[i] = torch.nan
        return x


def good(theta: Tensor, action: Tensor, seeds: Tensor) -> Tensor:
    """Return what :class:`Faulty` does without its faults."""
    return theta + row_normals(seeds, 1).float()


def cpu_time() -> float:
    """Return the CPU seconds of this process and all below it that live."""
    below = psutil.Process().children(recursive=True)
    times = [process.cpu_times() for process in below]
    return time.process_time() + sum(t.user + t.system for t in times)


def summary(values: list[float]) -> dict[str, float]:
    """Return the median and the quartiles."""
    low, _, high = quantiles(values, n=4, method="inclusive")
    rounded = {"median": median(values), "lower_quartile": low, "upper_quartile": high}
    return {name: round(value, 4) for name, value in rounded.items()}


def ratios(over: list[float], under: list[float]) -> list[float]:
    return [a / b for a, b in zip(over, under, strict=True)]


def overhead(
    num_rows: int, batch_size: int, repetitions: int, *, burns: bool, elsewhere: bool
) -> dict[str, Any]:
    """Compare the engine with a plain loop over the same batches, 1 ms a row."""
    theta = torch.rand(num_rows, 2)
    simulator = Timed(1e-3, burns=burns)
    seeds = row_seeds(0, num_rows)
    # One worker with a time limit is one process, and its calls travel.
    limit = 60.0 if elsewhere else None

    def loop() -> None:
        for start in range(0, num_rows, batch_size):
            rows = slice(start, start + batch_size)
            simulator(theta[rows], theta[rows], seeds[rows])

    def engine() -> None:
        simulate(
            simulator,
            theta,
            theta,
            seed=0,
            batch_size=batch_size,
            workers=Workers(time_limit=limit),
        )

    clock = cpu_time if burns else time.perf_counter
    seconds = in_turn({"plain": loop, "engine": engine}, repetitions, clock)
    relative = [r - 1 for r in ratios(seconds["engine"], seconds["plain"])]
    where = "in one worker process" if elsewhere else "in this process"
    own = described(burns, "CPU" if burns else "wall", num_rows, batch_size, seconds)
    return {"where": where, **own, "overhead": summary(relative)}


def described(
    burns: bool,
    clock: str,
    num_rows: int,
    batch_size: int,
    seconds: dict[str, list[float]],
) -> dict[str, Any]:
    """Return what was run, and the seconds of each variant."""
    return {
        "simulator": "burns the CPU" if burns else "waits",
        "clock": f"{clock} time",
        "rows": num_rows,
        "batch_size": batch_size,
        "repetitions": len(next(iter(seconds.values()))),
        "seconds": {name: summary(values) for name, values in seconds.items()},
    }


def workers(
    num_rows: int, batch_size: int, repetitions: int, *, burns: bool
) -> dict[str, Any]:
    """Compare one and two workers, the engine's and joblib's, 5 ms a row."""
    theta = torch.rand(num_rows, 2)
    simulator = Timed(5e-3, burns=burns)
    seeds = row_seeds(0, num_rows)

    def by_joblib(num: int) -> None:
        batches = [slice(i, i + batch_size) for i in range(0, num_rows, batch_size)]
        Parallel(n_jobs=num)(
            delayed(simulator)(theta[b], theta[b], seeds[b]) for b in batches
        )

    def by_engine(num: int) -> None:
        simulate(simulator, theta, theta, seed=0, workers=num, batch_size=batch_size)

    variants = {
        f"{name}_{num}": lambda run=run, num=num: run(num)
        for name, run in (("joblib", by_joblib), ("engine", by_engine))
        for num in (1, 2)
    }
    seconds = in_turn(variants, repetitions)
    ours = ratios(seconds["engine_1"], seconds["engine_2"])
    theirs = ratios(seconds["joblib_1"], seconds["joblib_2"])
    return {
        **described(burns, "wall", num_rows, batch_size, seconds),
        "speedup_engine": summary(ours),
        "speedup_joblib": summary(theirs),
    }


def faults(num_rows: int, num_workers: int) -> dict[str, Any]:
    """Simulate rows of which many go wrong, and compare the good ones."""
    theta = torch.arange(float(num_rows))[:, None]
    clean = simulate(good, theta, theta, seed=0)
    start = time.perf_counter()
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always", MissingRowsWarning)
        rows = simulate(
            Faulty(),
            theta,
            theta,
            seed=0,
            workers=Workers(num_workers=num_workers, time_limit=TIME_LIMIT),
        )
    same = bool(torch.equal(rows.x[rows.valid], clean.x[rows.valid]))
    index = torch.arange(num_rows)
    guilty = (index % 20 == 3) | (index % 100 == 57) | (index == 1_234)
    return {
        "rows": num_rows,
        "workers": num_workers,
        "time_limit_s": TIME_LIMIT,
        "seconds": time.perf_counter() - start,
        "counts": rows.counts,
        "warning": str(warned[0].message),
        "x_of_good_rows_unchanged": same,
        "missing_are_the_guilty": bool(torch.equal(rows.status == 2, guilty)),
    }


@dataclass(frozen=True)
class Settings:
    """What is run.

    Args:
        repetitions: Number of repetitions.
        out: File of the results.
    """

    repetitions: int = 9
    out: Path = Path(__file__).with_name("result.json")


def main(arguments: Settings) -> None:
    """Measure, write and print."""
    repetitions = arguments.repetitions
    result: dict[str, Any] = {
        "command": f"python -m benchmarks engine --repetitions {repetitions}",
        "date": datetime.now().isoformat(timespec="minutes"),
        "overhead": [],
        "workers": [],
    }
    for elsewhere in (False, True):
        for burns in (False, True):
            row = overhead(1_500, 250, repetitions, burns=burns, elsewhere=elsewhere)
            result["overhead"].append(row)
    for burns in (False, True):
        num_rows = 200 if burns else 400  # waiting takes nothing from others
        row = workers(num_rows, 20, repetitions, burns=burns)
        result["workers"].append(row)
    result["faults"] = faults(2_000, 2)
    keep(arguments.out, result)
    for name, value in leaves(result):
        print(f"{name}: {value}")
