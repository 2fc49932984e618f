"""The limit of the numerical model: exact posteriors, actions exact or at random.

    python -m benchmarks numerical.exact
    python -m benchmarks numerical.exact --summary

200 trials of four rounds at theta_true = (-3, 1), seeds 0 to 199 (nothing is tuned).
One row a trial and way of choosing, in benchmarks/numerical/results/exact.csv.
"""

from __future__ import annotations

import numpy as np

from benchmarks.numerical.run import REPORTED, RESULTS, exact_limits
from benchmarks.rows import benchmark
from sbi_active.seeding import derive_seed
from sbi_active.tasks import get_task
from sbi_active.tasks.numerical.exact_greedy import greedy_design

NUM_ROUNDS = 4


def row_of(way: str, seed: int) -> dict[str, object]:
    """Return log p(truth) by round and the errors of reproduction of one trial."""
    task = get_task("numerical")
    rng = np.random.default_rng(derive_seed(seed, "exact, random"))
    drawn = rng.integers(len(task.actions), size=NUM_ROUNDS).tolist()
    made = greedy_design(
        task.theta_true,
        task.actions.values,
        num_rounds=NUM_ROUNDS,
        seed=seed,
        chosen=None if way == "exact" else drawn,
    )
    row: dict[str, object] = {
        f"log_prob_{k + 1}": value for k, value in enumerate(made.log_prob)
    }
    pairs = zip(REPORTED, made.reproduction_error[-1], strict=True)
    return row | {f"rep_err_{action:g}": error for action, error in pairs}


main = benchmark(
    RESULTS / "exact.csv",
    row_of,
    lambda rows: "\n".join("  ".join((k, *v)) for k, v in exact_limits().items()),
    actions=("exact", "random"),
    seed=range(200),
)
