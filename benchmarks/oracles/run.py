"""Every way to a belief or an evidence on every problem with a known answer.

Problems, ways and limits are those of ``tests/oracles``; nothing may be tuned on them.
Resumable: a problem and way that stand in ``rows.csv`` are not run again.
"""

from __future__ import annotations

import time
import traceback
import warnings
from pathlib import Path

import torch

from benchmarks.oracles import table
from benchmarks.rows import benchmark
from tests.oracles.judging import judged
from tests.oracles.problems import PROBLEMS
from tests.oracles.reference import answers
from tests.oracles.ways import WAYS


def row_of(problem: str, way: str, seed: int) -> dict[str, object]:
    """Return the error of one way on one problem, its cost and what it says.

    Args:
        problem: Name of a problem.
        way: Name of a way.
        seed: Seed of the way.
    """
    (own, num_rows), used = PROBLEMS[problem]().counted(), WAYS[way]
    simulator = own.simulator(is_declared=used.is_declared)
    row: dict[str, object] = {}
    start = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            torch.manual_seed(seed)
            found = used.run(own, simulator, seed)
    except Exception as error:  # a row of the table as well
        where = traceback.extract_tb(error.__traceback__)[-1].name
        row |= {"error": f"{type(error).__name__} in {where}: {str(error)[:120]}"}
    else:
        row |= {"trustworthy": found.trustworthy}
        result = judged(own, answers()[problem], found)
        row |= {**vars(result), "faults": " ".join(result.faults())}
    cpu = time.process_time() - start
    return {**row, "rows": sum(num_rows), "cpu_seconds": round(cpu, 2)}


main = benchmark(
    Path(__file__).with_name("rows.csv"),
    row_of,
    table.text,
    skip=lambda problem, way, seed: not WAYS[way].claims(PROBLEMS[problem]()),
    problem=PROBLEMS,
    way=WAYS,
    seed=range(1),
)
