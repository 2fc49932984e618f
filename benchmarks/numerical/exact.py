"""The limit of the numerical model: exact posteriors, actions exact or at random.

    python -m benchmarks numerical.exact
    python -m benchmarks numerical.exact --summary

200 trials of four rounds at theta_true = (-3, 1), seeds 0 to 199 (nothing is tuned).
One row a trial and way of choosing, in benchmarks/numerical/results/exact.csv.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from benchmarks.numerical.run import NUM_EXACT, RESULTS, exact_limits
from benchmarks.rows import resumed
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

    def trial(way: str, seed: int) -> dict[str, object]:
        rng = np.random.default_rng(derive_seed(seed, "exact, random"))
        drawn = rng.integers(len(task.actions), size=NUM_ROUNDS).tolist()
        made = greedy_design(
            task.theta_true,
            task.actions.values,
            num_rounds=NUM_ROUNDS,
            seed=seed,
            chosen=None if way == "exact" else drawn,
        )
        values = [way, seed, *made.log_prob, *made.reproduction_error[-1]]
        return dict(zip(FIELDS, values, strict=True))

    task = get_task("numerical")
    jobs = [] if summary else product(("exact", "random"), range(NUM_EXACT))
    resumed(RESULTS / "exact.csv", FIELDS[:2], jobs, trial)
    for name, values in exact_limits().items():
        print(name, *values, sep="  ")
