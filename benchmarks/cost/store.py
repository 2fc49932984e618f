"""What keeping simulations on disk costs: small rows, rows of 1 MB, small sets.

    python -m benchmarks cost.store

* 1e6 rows of six numbers: appended in one call, and by 4,096 as ``simulate`` does; read
  whole, one column of them, and weighted for another target by ``reuse``;
* 200 rows of 1 MB: appended, read in chunks of ten, ten of them read one by one;
* 500 sets of ten rows, appended and looked up.

CPU and wall seconds, the file's bytes a row; writes store.json beside this file. A
``tell`` and the load of 200 trials are in ``benchmarks.cost.directory``.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import torch
from torch.distributions import Independent, Normal

from benchmarks.rows import keep
from sbi_active import Bank
from sbi_active.simulation import Simulations, reuse
from sbi_active.simulation.workers.store import run_digest

RESULT = Path(__file__).with_suffix(".json")
ROWS, FLUSH = 1_000_000, 4_096
LARGE, NUMBERS = 200, 250_000  # 1 MB in single precision
SETS = 500


def simulator(theta: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """Stands for what made the rows; it is never called."""
    raise NotImplementedError


def normal(mean: float, sd: float) -> Independent:
    """A proposal of two parameters."""
    return Independent(Normal(torch.full((2,), mean), torch.full((2,), sd)), 1)


def rows(num_rows: int, numbers: int, seed: int = 0) -> Simulations:
    """Rows of two parameters, one action and so many numbers."""
    generator = torch.Generator().manual_seed(seed)
    theta = torch.randn(num_rows, 2, generator=generator)
    action = torch.randint(5, (num_rows, 1), generator=generator).float()
    return Simulations(theta, action, torch.randn(num_rows, numbers))


def timed(results: dict[str, Any], name: str, work: Callable[[], Any]) -> Any:
    """Note CPU and wall seconds of a call."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    spent = time.process_time() - cpu, time.perf_counter() - wall
    results[name] = {"cpu_s": round(spent[0], 3), "wall_s": round(spent[1], 3)}
    print(name, results[name], flush=True)
    return result


def small_rows(folder: Path, results: dict[str, Any]) -> None:
    """Measure rows of six numbers."""
    six, prior = rows(ROWS, 3), normal(0.0, 1.0)

    def append() -> None:
        with Bank(folder / "one", simulator=simulator) as bank:
            bank.append(six, seed=0, proposal=prior, label="prior")

    def flushed() -> None:
        run = run_digest(0, six.theta, six.action)
        with Bank(folder / "many", simulator=simulator) as bank:
            store = bank.drawn_from(prior, label="prior")
            for start in range(0, ROWS, FLUSH):
                part = slice(start, start + FLUSH)
                columns = {n: getattr(six, n)[part] for n in ("theta", "action", "x")}
                index = torch.arange(ROWS)[part]
                store.save(run, index=index, **columns, status=six.status[part], seed=0)

    timed(results, "1e6 rows of six numbers, appended", append)
    timed(results, "1e6 rows of six numbers, by 4,096", flushed)
    for name in ("one", "many"):
        bank = Bank(folder / name)
        text = f"1e6 rows of six numbers ({name}), "
        timed(results, text + "read", bank.read)
        timed(results, text + "one column", lambda b=bank: b.columns("theta"))
        timed(results, text + "reused", lambda b=bank: reuse(b, normal(0.5, 0.7)))
        results[f"bytes a row ({name})"] = round(bank.num_bytes / ROWS, 1)


def large_rows(folder: Path, results: dict[str, Any]) -> None:
    """Measure rows of 1 MB."""
    large = rows(LARGE, NUMBERS)

    def append() -> None:
        with Bank(folder / "large", simulator=simulator) as bank:
            bank.append(large, seed=0)

    timed(results, f"{LARGE} rows of 1 MB, appended", append)
    bank = Bank(folder / "large")
    timed(results, f"{LARGE} rows of 1 MB, read by ten", lambda: [*bank.chunks(10)])
    timed(
        results,
        "ten rows of 1 MB, one by one",
        lambda: [bank.read([k]) for k in range(5, LARGE, LARGE // 10)],
    )
    results["bytes a row of 1 MB"] = round(bank.num_bytes / LARGE)


def small_sets(folder: Path, results: dict[str, Any]) -> None:
    """Measure many small sets of rows."""
    sets = [rows(10, 3, seed=seed) for seed in range(SETS)]

    def append() -> None:
        with Bank(folder / "sets", simulator=simulator) as bank:
            for seed, each in enumerate(sets):
                bank.append(each, seed=seed)

    timed(results, f"{SETS} sets of ten rows, appended", append)
    bank = Bank(folder / "sets")
    runs = [run_digest(k, each.theta, each.action) for k, each in enumerate(sets)]
    timed(results, f"{SETS} sets looked up", lambda: [bank.load(run) for run in runs])


def main() -> None:
    """Measure, print and write."""
    results: dict[str, Any] = {"date": str(date.today())}
    with tempfile.TemporaryDirectory() as name:
        for measure in (small_rows, large_rows, small_sets):
            measure(Path(name), results)
    keep(RESULT, results)


if __name__ == "__main__":
    main()
