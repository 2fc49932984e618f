"""The paper's Figures 11 and 12: log p(truth) and selected actions by round.

    python -m benchmarks pouring --bank FOLDER                  # both targets
    python -m benchmarks pouring --bank FOLDER --table coverage --rounds 3
    python -m benchmarks pouring --summary

Resumable: a trial that stands in the CSV is not run again. One row a round, one file a
method and target, in ``benchmarks/pouring/results``.

Algorithm 1 on 100 cubes. A campaign simulates nothing but its trials: the likelihood of
each action and summary is learned once from a bank of pours from the prior
(``likelihood``), a belief is the tempered product of its trials' on a grid, the action
(h, p, v, delta) chosen by the expected information gain under the same likelihoods.
NSBI has the same belief and random actions. ALHI and NLHI have one neural likelihood a
summary in their place (``network``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch

from benchmarks.pouring.campaign import TEMPERED, rounds
from benchmarks.pouring.grid_belief import GridBelief
from benchmarks.pouring.learned import ByAction, learn
from benchmarks.pouring.network import ByNetwork, learn_networks
from benchmarks.pouring.summary import mean_log_p, summarize
from benchmarks.rounds import coverage_table
from benchmarks.rows import read, resumed
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.tasks import get_task

RESULTS = Path(__file__).parent / "results"
METHODS = ("asbi", "nsbi", "alhi", "nlhi")
ACTIVE, BY_NETWORK = ("asbi", "alhi"), ("alhi", "nlhi")
NUM_DRAWS = 2_000  # behind the share of a belief that is denser than the truth


def run_trial(
    task: Any, learned: ByAction | ByNetwork, is_active: bool, seed: int, num: int
) -> list[dict[str, object]]:
    """Return one row a round of one campaign."""
    rows: list[dict[str, object]] = []
    for found in rounds(
        *(task, learned, lambda log_p: GridBelief(torch.from_numpy(log_p))),
        GridBelief.middles().double().numpy(),
        num=num,
        seed=seed,
        is_active=is_active,
        tempered=TEMPERED if isinstance(learned, ByAction) else 0.0,
    ):
        log_p = float(found.belief.log_prob(task.theta_true))
        with forked_generators(derive_seed(seed, "draws", found.index)):
            draws = found.belief.sample(torch.Size([NUM_DRAWS]))
        row = found.row() | {
            "theta_true": " ".join(f"{v:.6g}" for v in task.theta_true.tolist()),
            "eig_se": float(found.error[found.delta, found.place]),
            "eig_pca": float(found.gain[0].max()),
            "eig_mesh": float(found.gain[1].max()),
            "log_prob_true": log_p,
            "hpd": float((found.belief.log_prob(draws) > log_p).double().mean()),
            "num_rows": learned.num if isinstance(learned, ByNetwork) else 0,
            "power": np.nan,
        }
        if isinstance(learned, ByAction):
            own = learned.learned[found.delta][found.place]
            row |= {"num_rows": own.num, "power": own.likelihood.power}
        rows.append(row)
    return rows


@dataclass(frozen=True)
class Settings:
    """What is run.

    Args:
        table: Name of the table.
        bank: Folder of pours; needed for all but the summary.
        target: Target of the paper; both by default.
        methods: Names of methods.
        trials: Number of trials.
        first: Seed of the first trial.
        rounds: Number of rounds.
        results: Folder of the results.
        summary: Whether to run nothing, and print the table of the rows.
    """

    table: Literal["paper", "coverage"] = "paper"
    bank: Path = Path()
    target: Literal["1", "2"] | None = None
    methods: Annotated[Sequence[str], METHODS] = (*METHODS,)
    trials: int = 5
    first: int = 2_200
    rounds: int = 6
    results: Path = RESULTS
    summary: bool = False

    def __post_init__(self) -> None:
        if self.bank == Path() and not self.summary:
            raise SystemExit("expected --bank FOLDER; got none; make one, see bank.py")


def known(method: str, bank: Path) -> ByAction | ByNetwork:
    """Return what a method learns of the bank."""
    is_network = method in BY_NETWORK
    return learn_networks(bank) if is_network else learn(bank, get_task("pouring"))


def make_task(target: str, seed: int) -> Any:
    """Return a target of the paper, or a truth drawn from the prior."""
    if target != "prior":
        return get_task("pouring", target=int(target))
    task = get_task("pouring")
    with forked_generators(derive_seed(seed, "truth")):
        return task.with_truth(task.prior.sample(torch.Size([1]))[0])


def path_of(method: str, target: str, arguments: Settings) -> Path:
    """Return the file of a method and target."""
    return arguments.results / f"target_{target}_{method}.csv"


def run_missing(
    method: str,
    target: str,
    learned: ByAction | ByNetwork,
    arguments: Settings,
) -> None:
    """Run the trials that are not in the file yet."""

    def trial(seed: int) -> list[dict[str, object]]:
        task = make_task(target, seed)
        return run_trial(task, learned, method in ACTIVE, seed, arguments.rounds)

    last = arguments.first + arguments.trials
    seeds = [(seed,) for seed in range(arguments.first, last)]
    path = path_of(method, target, arguments)
    resumed(path, ["seed"], seeds, trial)


def main(arguments: Settings) -> None:
    """Run the trials that are not there yet, and print the table."""
    is_coverage = arguments.table == "coverage"
    targets = [arguments.target] if arguments.target else ["1", "2"]
    targets = ["prior"] if is_coverage else targets
    if not arguments.summary:
        for method in arguments.methods:
            learned = known(method, arguments.bank)
            for target in targets:
                run_missing(method, target, learned, arguments)
    cells = {}
    for method in arguments.methods:
        for target in targets:
            rows = read(path_of(method, target, arguments))
            if rows:
                cells[method, target] = rows
    if is_coverage:
        last = ("mean log p", mean_log_p)
        print(coverage_table(cells, range(1, arguments.rounds + 1), last))
    else:
        print(summarize(cells))
