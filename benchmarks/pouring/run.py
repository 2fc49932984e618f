"""The paper's Figures 11 and 12: log p(truth) and selected actions by round.

    python -m benchmarks.pouring.run --bank FOLDER                  # both targets
    python -m benchmarks.pouring.run --bank FOLDER --table coverage --rounds 3
    python -m benchmarks.pouring.run --summary

Resumable: a trial that stands in the CSV is not run again. One row a round, one file a
method and target, in ``benchmarks/pouring/results``.

Algorithm 1 on 100 cubes. A round's rows are drawn with replacement from a bank of pours
from the prior, so that a round simulates nothing but its trial; how many distinct pours
it rests on is a column. They are weighted by the belief b to a power, the proposal
pi = b^tau with as many effective rows as ``--effective`` says, and the next belief is
b(theta) q(theta | x_o, xi) / pi(theta). With ``--effective 0`` tau is 1 and the beliefs
are chained as in the paper; a bank is then too thin from round 3 on.
One network a summary; the action is (h, p, v, delta), and delta is compared on common
pours: a fifth of the bank, which no network learns from.
"""

from __future__ import annotations

import argparse
import csv
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.pouring.bank import read as read_bank
from benchmarks.pouring.grid_belief import GridBelief
from benchmarks.pouring.summary import coverage_table, read, summarize
from sbi_active import ASBI, MixtureDensity
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.tasks import get_task
from sbi_active.tasks.pouring import images_of, mesh_coverage

RESULTS = Path(__file__).parent / "results"
METHODS = ("asbi", "nsbi")
NUM_DRAWS = 2_000  # behind the share of a belief that is denser than the truth
FEWEST = 5  # effective held-out pours of an action, to be compared with others
COLUMNS = [
    *["seed", "theta_true", "round", "height", "position", "rate", "delta", "in_view"],
    *["eig", "eig_se", "eig_pca", "eig_mesh", "log_prob_true", "hpd"],
    *["num_distinct", "effective", "cpu_training", "cpu_design", "cpu_trial"],
]


@dataclass(frozen=True)
class Pool:
    """Pours that rounds draw on.

    Attributes:
        theta: Shape (n, 3).
        action: Shape (n, 3).
        images: Shape (n, 22500).
        coverage: Shape (n, 36).
        is_held_out: Whether a row is kept from training, shape (n,).
    """

    theta: Tensor
    action: Tensor
    images: Tensor
    coverage: Tensor
    is_held_out: Tensor

    @classmethod
    def of(cls, folder: Path, task: Any, most: int | None) -> Pool:
        """Read a bank."""
        rows = read_bank(folder, most=most)
        images = images_of(rows.poses, task.pours.particles)
        held_out = torch.arange(len(rows)) % 5 == 0
        return cls(rows.theta, rows.action, images, mesh_coverage(images), held_out)


def run_trial(
    task: Any, pool: Pool, method: str, seed: int, arguments: argparse.Namespace
) -> list[dict[str, object]]:
    """Return one row a round of one campaign."""
    belief = GridBelief.uniform()
    rows = []
    for index in range(arguments.rounds):
        start = time.process_time()
        proposal = belief.flattened(pool.theta, arguments.effective)
        weight = proposal.log_prob(pool.theta).softmax(0)
        trained, distinct = train(task, pool, weight, seed, index, arguments)
        learned = time.process_time()
        gains, errors = zip(
            *[
                expected_gain(task, pool, weight, proposal, inference, x)
                for inference, x, _ in trained
            ],
            strict=True,
        )
        gain, error = torch.stack(gains), torch.stack(errors)  # (2, actions)
        if method == "asbi":
            choice = int(gain.argmax())
        else:
            with forked_generators(derive_seed(seed, "action", index)):
                choice = int(torch.randint(gain.numel(), ()))
        delta, place = divmod(choice, gain.shape[1])
        action = task.actions.values[place]
        designed = time.process_time()
        image = task.real_system(action, seed=derive_seed(seed, "real", index))
        inference, _, summary = trained[delta]
        log_q = at_trial(inference, summary(image[None]), action)
        belief = GridBelief(log_q + belief.log_density - proposal.log_density)
        log_q = float(belief.log_prob(task.theta_true))
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
                "log_prob_true": log_q,
                "hpd": float((belief.log_prob(draws) > log_q).double().mean()),
                "num_distinct": distinct,
                "effective": float(1 / (weight**2).sum()),
                "cpu_training": learned - start,
                "cpu_design": designed - learned,
                "cpu_trial": time.process_time() - designed,
            }
        )
    return rows


def train(
    task: Any,
    pool: Pool,
    weight: Tensor,
    seed: int,
    index: int,
    arguments: argparse.Namespace,
) -> tuple[list[Any], int]:
    """Return a network, the pool's rows and the summary of each, and distinct rows.

    A first round depends on nothing but the pool, and so is kept.
    """
    if index == 0:
        if "first" not in _kept:
            _kept["first"] = learn(task, pool, weight, 0, index, arguments)
        return _kept["first"]
    return learn(task, pool, weight, seed, index, arguments)


_kept: dict[str, Any] = {}


def learn(
    task: Any,
    pool: Pool,
    weight: Tensor,
    seed: int,
    index: int,
    arguments: argparse.Namespace,
) -> tuple[list[Any], int]:
    """Train as :func:`train` says."""
    learning = weight * ~pool.is_held_out
    with forked_generators(derive_seed(seed, "rows", index)):
        drawn = learning.multinomial(arguments.draws, replacement=True)
    distinct = drawn.unique()
    summaries = task.summaries(
        pool.images[distinct[:600]], num_components=arguments.components
    )
    used = torch.cat([distinct, torch.nonzero(pool.is_held_out)[:, 0]])
    trained = []
    for delta, summary in enumerate(summaries.values()):
        x = pool.coverage
        if not delta:
            z = summary(pool.images[used])
            x = torch.zeros(len(pool.theta), z.shape[1])
            x[used] = z
        with forked_generators(derive_seed(seed, "train", index, delta)):
            inference = ASBI(task.prior, NETWORK, show_progress_bars=False)
            inference.append_simulations(
                pool.theta[drawn], x[drawn], action=pool.action[drawn]
            ).train()
        trained.append((inference, x, summary))
    return trained, len(distinct)


def at_trial(inference: ASBI, x: Tensor, action: Tensor) -> Tensor:
    """Return the network's log density at the middles of the grid, one trial's."""
    theta = GridBelief.middles()
    posterior = inference.build_posterior()
    parts = [
        posterior.log_posterior(
            part, x.expand(len(part), -1), action.expand(len(part), -1)
        ).detach()
        for part in theta.split(8_000)
    ]
    return torch.cat(parts).double()


NETWORK = MixtureDensity(hidden_features=(64, 64), num_components=5)


def expected_gain(
    task: Any, pool: Pool, weight: Tensor, belief: Any, inference: Any, x: Tensor
) -> tuple[Tensor, Tensor]:
    r"""Return :math:`E[\log q(\theta | x, \xi) - \log b(\theta)]` and its error.

    Of each action, over the held-out pours by the weights of the belief; minus infinity
    where these are too few.
    """
    rows = torch.nonzero(pool.is_held_out & (weight > 1e-9))[:, 0]
    theta, action = pool.theta[rows], pool.action[rows]
    log_q = inference.build_posterior().log_posterior(theta, x[rows], action).double()
    log_ratio = (log_q - belief.log_prob(theta).double()).clamp(min=-20)
    values = task.actions.values
    gain = torch.full((len(values),), -torch.inf, dtype=torch.float64)
    error = torch.full_like(gain, torch.inf)
    for k, value in enumerate(values):
        mine = (action == value).all(1)
        share = weight[rows][mine]
        total = share.sum()
        if not mine.any() or total <= 0:
            continue
        share = share / total
        effective = 1 / (share**2).sum()
        if effective < FEWEST:
            continue
        gain[k] = (share * log_ratio[mine]).sum()
        variance = (share * (log_ratio[mine] - gain[k]) ** 2).sum()
        error[k] = (variance / effective).sqrt()
    return gain.detach(), error.detach()


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
    method: str, target: str, pool: Pool, arguments: argparse.Namespace
) -> None:
    """Run the trials that are not in the file yet."""
    path = path_of(method, target, arguments)
    path.parent.mkdir(parents=True, exist_ok=True)
    done = {int(row["seed"]) for row in read(path)}
    for seed in range(arguments.first, arguments.first + arguments.trials):
        if seed in done:
            continue
        start = time.process_time()
        rows = run_trial(make_task(target, seed), pool, method, seed, arguments)
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
    parser.add_argument("--table", choices=["paper", "coverage"], default="paper")
    parser.add_argument("--bank", type=Path, help="folder of pours")
    parser.add_argument("--most", type=int, help="pours to take of it (all)")
    parser.add_argument("--target", choices=["1", "2"], help="one alone (both)")
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=[*METHODS])
    parser.add_argument("--trials", type=int, default=5)
    parser.add_argument("--first", type=int, default=2_000, help="seed of the first")
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--draws", type=int, default=3_000, help="rows a round")
    parser.add_argument(
        "--effective",
        type=float,
        default=4_000,
        help="pours that a round rests on at least; 0 chains beliefs as the paper does",
    )
    parser.add_argument("--components", type=int, default=36)
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
        pool = Pool.of(arguments.bank, get_task("pouring"), arguments.most)
        for target in targets:
            for method in arguments.methods:
                run_missing(method, target, pool, arguments)
    cells = {}
    for method in arguments.methods:
        for target in targets:
            rows = read(path_of(method, target, arguments))
            if rows:
                cells[method, target] = rows
    print(coverage_table(cells) if is_coverage else summarize(cells))


if __name__ == "__main__":
    main()
