"""The limit of the numerical model: exact posteriors, actions exact or at random.

    python -m benchmarks numerical.exact
    python -m benchmarks numerical.exact --summary

200 trials of four rounds at theta_true = (-3, 1), seeds 0 to 199 (nothing is tuned).
One row a trial and way of choosing, in benchmarks/numerical/results/exact.csv.
"""

from __future__ import annotations

import csv

import numpy as np
import torch

from benchmarks.numerical.run import NUM_EXACT, RESULTS, exact_limits
from sbi_active.seeding import derive_seed
from sbi_active.tasks import get_task
from sbi_active.tasks.numerical.exact_greedy import greedy_design

NUM_ROUNDS = 4
FIELDS = ["actions", "seed", *(f"log_prob_{r + 1}" for r in range(NUM_ROUNDS))]
FIELDS += ["rep_err_-3", "rep_err_0", "rep_err_3"]


def main(*, summary: bool = False) -> None:
    """Run what is missing and print the table.

    Args:
        summary: Whether to run nothing, and print the table of the rows.
    """
    torch.set_num_threads(1)
    if not summary:
        task = get_task("numerical")
        actions = task.actions.values
        with (RESULTS / "exact.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(FIELDS)
            for way in ("exact", "random"):
                for seed in range(NUM_EXACT):
                    rng = np.random.default_rng(derive_seed(seed, "exact, random"))
                    drawn = rng.integers(len(actions), size=NUM_ROUNDS).tolist()
                    done = greedy_design(
                        task.theta_true,
                        actions,
                        num_rounds=NUM_ROUNDS,
                        seed=seed,
                        chosen=None if way == "exact" else drawn,
                    )
                    values = [*done.log_prob, *done.reproduction_error[-1]]
                    writer.writerow([way, seed, *(f"{float(v):.5g}" for v in values)])
                    file.flush()
    for name, values in exact_limits().items():
        print(name, *values, sep="  ")
