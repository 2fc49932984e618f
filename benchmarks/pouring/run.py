"""The paper's Figures 11 and 12: log p(truth) and selected actions by round.

    python -m benchmarks.pouring.run --bank FOLDER                  # both targets
    python -m benchmarks.pouring.run --bank FOLDER --table coverage --rounds 3
    python -m benchmarks.pouring.run --bank FOLDER --table bank     # left-out pours
    python -m benchmarks.pouring.run --summary

Resumable: a trial that stands in the CSV is not run again. One row a round, one file a
method and target, in ``benchmarks/pouring/results``.

Algorithm 1 on 100 cubes. A campaign simulates nothing but its trials: the likelihood of
each action and summary is learned once from a bank of pours from the prior
(``likelihood``), a belief is the product of its trials' on a grid, and the action
(h, p, v, delta) is chosen by the expected information gain under the same likelihoods.
NSBI has the same belief and random actions.
"""

from __future__ import annotations

import argparse
import csv
import pickle
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.pouring.bank import read as read_bank
from benchmarks.pouring.grid_belief import GridBelief
from benchmarks.pouring.likelihood import (
    ImageLikelihood,
    components,
    cross_validated,
    observed,
    thumbnails,
)
from benchmarks.pouring.reference import abc_log_prob
from benchmarks.pouring.summary import (
    bank_table,
    coverage_table,
    read,
    reference_table,
    summarize,
)
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.tasks import get_task
from sbi_active.tasks.pouring import images_of, mesh_coverage

RESULTS = Path(__file__).parent / "results"
METHODS = ("asbi", "nsbi")
NUM_DRAWS = 2_000  # behind the share of a belief that is denser than the truth
NUM_OUTER, NUM_ALL = 100, 300  # draws behind an expected gain
NUM_COMPONENTS = 36
COLUMNS = [
    *["seed", "theta_true", "round", "height", "position", "rate", "delta", "in_view"],
    *["eig", "eig_se", "eig_pca", "eig_mesh", "log_prob_true", "hpd"],
    *["num_rows", "power", "cpu_design", "cpu_trial"],
]


@dataclass(frozen=True)
class Learned:
    """What one summary of an action's pours tells.

    Attributes:
        likelihood: Learned from them.
        num: Pours behind it.
        told: Log posterior density of each left-out pour's theta, shape (num,).
        mass: Of what is denser, shape (num,).
        mean: Of thumbnails, shape (900,), where the summary is components.
        axes: Shape (900, k).
    """

    likelihood: ImageLikelihood
    num: int
    told: np.ndarray
    mass: np.ndarray
    mean: np.ndarray
    axes: np.ndarray

    def log_prob(self, theta: Tensor, image: Tensor, delta: int) -> Tensor:
        """Return log densities of an image (22500,) at theta (n, 3)."""
        coverage = mesh_coverage(image[None]).numpy().astype(np.float64)
        summary = np.sqrt(coverage)
        if not delta:
            summary = (thumbnails(image[None].numpy()) - self.mean) @ self.axes
        seen = observed(self.likelihood, summary[0], not coverage.any())
        return torch.from_numpy(self.likelihood.at(theta.double().numpy(), seen))


def learn(folder: Path, task: Any, most: int | None) -> list[list[Learned]]:
    """Return what is learned of a bank, by delta and action."""
    found: list[list[Learned]] = [[], []]
    for delta, theta, summary, is_empty, basis in summarized(folder, task, most):
        fitted, told, mass = cross_validated(theta, summary, is_empty)
        found[delta].append(Learned(fitted, len(theta), told, mass, *basis))
    return found


def summarized(folder: Path, task: Any, most: int | None) -> Iterator[tuple[Any, ...]]:
    """Yield delta, theta, summaries, whether empty, and components, by action."""
    rows = read_bank(folder, most=most)
    coverage, pictures = [], []
    for start in range(0, len(rows), 500):
        images = images_of(rows.poses[start : start + 500], task.pours.particles)
        coverage.append(mesh_coverage(images).numpy().astype(np.float64))
        pictures.append(thumbnails(images.numpy()))
    mesh, small = np.concatenate(coverage), np.concatenate(pictures)
    theta = rows.theta.double().numpy()
    for action in task.actions.values:
        mine = (rows.action == action).all(1).numpy()
        is_empty = ~mesh[mine].any(1)
        mean, axes = components(small[mine], NUM_COMPONENTS)
        summaries = (small[mine] - mean) @ axes, np.sqrt(mesh[mine])
        for delta, summary in enumerate(summaries):
            yield delta, theta[mine], summary, is_empty, (mean, axes)


def by_nearest(folder: Path, task: Any, most: int | None) -> list[list[np.ndarray]]:
    """Return what nearest pours alone tell of left-out ones, by delta and action."""
    found: list[list[np.ndarray]] = [[], []]
    for delta, theta, summary, *_ in summarized(folder, task, most):
        found[delta].append(abc_log_prob(theta, summary))
    return found


def run_trial(
    task: Any, learned: list[list[Learned]], method: str, seed: int, rounds: int
) -> list[dict[str, object]]:
    """Return one row a round of one campaign."""
    belief, middles = GridBelief.uniform(), GridBelief.middles()
    rows = []
    for index in range(rounds):
        start = time.process_time()
        gain = error = np.full((2, len(task.actions.values)), np.nan)
        if method == "asbi":
            own_seed = derive_seed(seed, "gain", index)
            gain, error = expected_gains(learned, belief, own_seed)
            choice = int(gain.argmax())
        else:
            with forked_generators(derive_seed(seed, "action", index)):
                choice = int(torch.randint(gain.size, ()))
        delta, place = divmod(choice, gain.shape[1])
        action = task.actions.values[place]
        designed = time.process_time()
        image = task.real_system(action, seed=derive_seed(seed, "real", index))
        own = learned[delta][place]
        belief = GridBelief(belief.log_density + own.log_prob(middles, image, delta))
        log_p = float(belief.log_prob(task.theta_true))
        with forked_generators(derive_seed(seed, "draws", index)):
            draws = belief.sample(torch.Size([NUM_DRAWS]))
        rows.append(
            {
                "seed": seed,
                "theta_true": " ".join(f"{v:.6g}" for v in task.theta_true.tolist()),
                "round": index + 1,
                **dict(
                    zip(("height", "position", "rate"), action.tolist(), strict=True)
                ),
                "delta": delta,
                "in_view": float((image > 0).float().mean()),
                "eig": float(gain[delta, place]),
                "eig_se": float(error[delta, place]),
                "eig_pca": float(gain[0].max()),
                "eig_mesh": float(gain[1].max()),
                "log_prob_true": log_p,
                "hpd": float((belief.log_prob(draws) > log_p).double().mean()),
                "num_rows": own.num,
                "power": own.likelihood.power,
                "cpu_design": designed - start,
                "cpu_trial": time.process_time() - designed,
            }
        )
    return rows


def expected_gains(
    learned: list[list[Learned]], belief: GridBelief, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return gains by delta and action, nats, and their errors, on common draws."""
    with forked_generators(seed):
        theta = belief.sample(torch.Size([NUM_ALL])).double().numpy()
    gains = [
        [
            own.likelihood.gain(theta, NUM_OUTER, np.random.default_rng(seed))
            for own in by_action
        ]
        for by_action in learned
    ]
    values = np.array(gains)
    return values.mean(2), values.std(2) / np.sqrt(NUM_OUTER)


def kept(arguments: argparse.Namespace) -> list[list[Learned]]:
    """Return what is learned of the bank, from a file of our own where there is one."""
    path = arguments.learned
    if path is not None and path.exists():
        return pickle.loads(path.read_bytes())
    learned = learn(arguments.bank, get_task("pouring"), arguments.most)
    if path is not None:
        path.write_bytes(pickle.dumps(learned))
    return learned


def make_task(target: str, seed: int) -> Any:
    """Return a target of the paper, or a truth drawn from the prior."""
    if target != "prior":
        return get_task("pouring", target=int(target))
    task = get_task("pouring")
    with forked_generators(derive_seed(seed, "truth")):
        return task.with_truth(task.prior.sample(torch.Size([1]))[0])


def path_of(method: str, target: str, arguments: argparse.Namespace) -> Path:
    """Return the file of a method and target."""
    return arguments.results / f"target_{target}_{method}.csv"


def run_missing(
    method: str,
    target: str,
    learned: list[list[Learned]],
    arguments: argparse.Namespace,
) -> None:
    """Run the trials that are not in the file yet."""
    path = path_of(method, target, arguments)
    path.parent.mkdir(parents=True, exist_ok=True)
    done = {int(row["seed"]) for row in read(path)}
    for seed in range(arguments.first, arguments.first + arguments.trials):
        if seed in done:
            continue
        start = time.process_time()
        rows = run_trial(
            make_task(target, seed), learned, method, seed, arguments.rounds
        )
        is_new = not path.exists()
        with path.open("a", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            if is_new:
                writer.writeheader()
            writer.writerows({k: short(v) for k, v in row.items()} for row in rows)
        spent = time.process_time() - start
        values = " ".join(f"{row['log_prob_true']:.2f}" for row in rows)
        print(f"{path.stem} {seed}: {values}, {spent:.0f} CPU s", flush=True)


def short(value: object) -> object:
    """Return a number with six digits."""
    return f"{value:.6g}" if isinstance(value, float) else value


def parse() -> argparse.Namespace:
    """Return the arguments."""
    parser = argparse.ArgumentParser(description="The paper's pouring.")
    parser.add_argument(
        "--table", choices=["paper", "coverage", "bank"], default="paper"
    )
    parser.add_argument("--bank", type=Path, help="folder of pours")
    parser.add_argument("--learned", type=Path, help="keeps what is learned of it")
    parser.add_argument("--most", type=int, help="pours to take of it (all)")
    parser.add_argument("--target", choices=["1", "2"], help="one alone (both)")
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=[*METHODS])
    parser.add_argument("--trials", type=int, default=5)
    parser.add_argument("--first", type=int, default=2_000, help="seed of the first")
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--summary", action="store_true", help="run nothing")
    arguments = parser.parse_args()
    if arguments.bank is None and not arguments.summary:
        parser.error("expected --bank FOLDER; got none; make one, see bank.py")
    return arguments


def main() -> None:
    arguments = parse()
    torch.set_num_threads(1)
    is_coverage = arguments.table == "coverage"
    targets = [arguments.target] if arguments.target else ["1", "2"]
    targets = ["prior"] if is_coverage else targets
    if not arguments.summary:
        learned = kept(arguments)
        if arguments.table == "bank":
            nearest = by_nearest(arguments.bank, get_task("pouring"), arguments.most)
            print(bank_table(learned), reference_table(learned, nearest), sep="\n\n")
            return
        for target in targets:
            for method in arguments.methods:
                run_missing(method, target, learned, arguments)
    cells = {}
    for method in arguments.methods:
        for target in targets:
            rows = read(path_of(method, target, arguments))
            if rows:
                cells[method, target] = rows
    print(coverage_table(cells) if is_coverage else summarize(cells))


if __name__ == "__main__":
    main()
