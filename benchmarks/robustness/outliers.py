"""One of eight trials is off by many standard deviations: is it named, or an effect?

    python -m benchmarks robustness.outliers
    python -m benchmarks robustness.outliers --summary

World A is the numerical model with seven declared effects, world B the sliding block
with its library, whose trials have six numbers, all of them off by as much. In each set
another trial, drawn at random, is off; eight further trials are right and held out. The
verdict "alone" is that without held-out trials.

Resumable: a set that stands in ``results/outliers.csv`` is not run again.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.criticism.cases import draw_case
from benchmarks.criticism.worlds import get_world
from benchmarks.rows import benchmark
from sbi_active.criticism import Trials
from sbi_active.criticism.report.summary import suspects
from sbi_active.seeding import derive_seed

RESULTS = Path(__file__).parent / "results" / "outliers.csv"
#: Number of sets, by world and size of the error in standard deviations.
SETS = {("A", 8): 40, ("A", 20): 40, ("A", 0): 20, ("B", 8): 20, ("B", 20): 20}
CATCH_ALLS = ("none", "unexplained", "scatter", "outlier")


def measure(name: str, size: int, number: int) -> dict[str, object]:
    """Return the row of one set.

    Args:
        name: Of the world.
        size: Of the error, in standard deviations of the noise.
        number: Of the set.
    """
    world = get_world(name)
    problem = draw_case(world, "clean", number).problem
    trials, num = problem.trials, len(problem.trials.fit)
    generator = torch.Generator().manual_seed(derive_seed(number, "outlier"))
    trial = int(torch.randint(num, (1,), generator=generator))
    sign = 2 * int(torch.randint(2, (1,), generator=generator)) - 1
    x = trials.x.clone()
    x[trial] += sign * size * world.noise_sd
    wrong = Trials(trials.action, x, role=trials.role, index=trials.index)
    start = time.process_time()
    loop = replace(problem, trials=wrong).criticism(number)
    alone = loop.trace()
    report = loop.report(plan=False)
    rmse = report.before_after.set_index("metric").to_dict("index")["rmse"]
    spent = loop.rivals.simulator.num_simulations
    return {
        "trial": trial,
        "action": float(trials.action[trial, 0]),
        "verdict": report.verdict,
        "alone": alone.verdict,
        "instead_of": report.tracing.instead_of,
        "suspects": " ".join(f"{i:g}" for i in suspects(report.tracing)),
        "probability": f"{report.probabilities.get(report.verdict, 0.0):.3f}",
        "rmse_before": f"{rmse['before']:.3g}",
        "rmse_after": f"{rmse['after']:.3g}",
        "trial_simulations": spent,
        "cpu_seconds": f"{time.process_time() - start:.1f}",
    }


def shares(rows: list[dict[str, str]]) -> Iterator[str]:
    """Yield the shares of each setting."""
    for world, size in SETS:
        some = [r for r in rows if (r["world"], int(r["size"])) == (world, size)]
        if not some:
            continue
        effects = sum(r["verdict"] not in CATCH_ALLS for r in some)
        alone = sum(r["alone"] not in CATCH_ALLS for r in some)
        named = sum(
            r["verdict"] == "outlier" and r["trial"] in r["suspects"].split()
            for r in some
        )
        single = sum(
            r["verdict"] == "outlier" and r["trial"] == r["suspects"] for r in some
        )
        yield (
            f"world {world}, +-{size} sd: an effect named in {effects} of {len(some)} "
            f"(without held-out trials {alone}), the trial named in {named}, it alone "
            f"in {single}, alarms in {sum(r['verdict'] != 'none' for r in some)}"
        )


main = benchmark(
    RESULTS,
    measure,
    lambda rows: "\n".join(shares(rows)),
    skip=lambda world, size, case: case >= SETS.get((world, size), 0),
    world=("A", "B"),
    size=(8, 20, 0),
    case=range(40),
)
