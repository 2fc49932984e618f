"""Robust updates beside plain ones on the numerical task, one gross outlier in ten.

    python -m benchmarks chain.robust --seeds 2000 2010
    python -m benchmarks chain.robust --summary

Ten trials at random actions. In "gross" one of them, drawn by the seed, is off by 100
deviations of the noise; "clean" has none. Both methods take the word of the same kind
of network (no refinement), trained under their own belief in each round. Rows are added
to robust.csv in --out, and those that are there are not run again. Seeds from 2000 on
judge.
"""

from __future__ import annotations

import time
from typing import Any

import pandas as pd
import torch

from benchmarks.chain.run import RESULTS
from benchmarks.rows import benchmark, frame
from sbi_active import ASBI
from sbi_active.display.table import Table
from sbi_active.pyro import RobustASBI
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import simulate
from sbi_active.tasks import get_task  # pyright: ignore

NUM_TRIALS, NUM_ROWS, GROSS = 10, 3_000, 100.0
METHODS: dict[str, Any] = {"plain": ASBI, "robust": RobustASBI}


def judged(seed: int, case: str, method: str) -> dict[str, Any]:
    task = get_task("numerical")
    with forked_generators(seed, "truth"):
        task = task.with_truth(task.prior.sample())
        which = int(torch.randint(NUM_TRIALS, ()))
        sign = float(torch.randn(()).sign())
    inference = METHODS[method](task.prior)
    chosen = task.actions.sample((NUM_TRIALS,), seed=derive_seed(seed, "trials"))
    belief, flagged, others, r_hat = task.prior, 0.0, [], 1.0
    ess = float("inf")
    start = time.process_time()
    for i, action in enumerate(chosen):
        own = derive_seed(seed, "round", i)
        with forked_generators(own):
            theta = belief.sample((NUM_ROWS,))
            actions = task.actions.sample((NUM_ROWS,))
            rows = simulate(task.simulator, theta, actions, seed=own)
            inference.append_simulations(theta, rows.x, action=actions, belief=belief)
            inference.train()
        x = task.real_system(action, seed=derive_seed(seed, i))
        is_off = case == "gross" and i == which
        if is_off:
            x = x + sign * GROSS
        if method == "robust":
            belief = inference.update(
                x, action=action, simulator=task.simulator, seed=own
            )
            found = inference.denoised[-1]
            r_hat = max(r_hat, found.r_hat)
            ess = min(ess, found.effective_sample_size)
            if is_off:
                flagged = float(found.probability[0])
            else:
                others.append(float(found.probability[0]))
        else:
            belief = inference.update(x, action=action, seed=own)
    return {
        "log_prob_truth": float(belief.log_prob(task.theta_true)),
        "probability_outlier": flagged,
        "probability_others": max(others, default=0.0),
        "largest_r_hat": r_hat,
        "least_effective": ess,
        "cpu_s": time.process_time() - start,
    }


def summary(rows: pd.DataFrame) -> str:
    """Return a line a case; only seeds that both methods ran count."""
    lines = []
    for case, part in rows.groupby("case"):
        if {*METHODS} - {*part["method"]}:
            continue
        table: Any = part.pivot(index="seed", columns="method", values="log_prob_truth")
        table = table.dropna()
        own: Any = part[part["method"] == "robust"]
        gain, r_hat = table["robust"] - table["plain"], own["largest_r_hat"]
        cost = part.groupby("method")["cpu_s"].median()
        lines.append(
            [
                *(str(case), str(len(table))),
                f"{gain.median():.3g}",
                f"{gain.min():.3g} to {gain.max():.3g}",
                f"{own['probability_outlier'].median():.2f}",
                f"{own['probability_others'].max():.2f}",
                f"{r_hat.median():.2f} ({r_hat.max():.2f})",
                f"{own['least_effective'].min():.0f}",
                *(f"{cost[m]:.0f}" for m in METHODS),
            ]
        )
    header = ["case", "seeds", "median gain", "least to most, nats", "P(outlier)"]
    header += ["largest P of others", "largest r_hat: median (most)"]
    header += ["least effective draws"]
    return Table([*header, *(f"CPU s, {m}" for m in METHODS)], lines).text()


main = benchmark(
    RESULTS / "robust.csv",
    judged,
    lambda rows: summary(frame(rows)),
    seed=range(2000, 2010),
    case=("gross", "clean"),
    method=METHODS,
)
