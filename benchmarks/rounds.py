"""Campaigns by round, and tables of several methods on several targets."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats
from torch import Tensor

from benchmarks.rows import column, grouped
from sbi_active import Campaign
from sbi_active.display.table import Table
from sbi_active.seeding import derive_seed, forked_generators

Rows = Sequence[Mapping[str, str]]
Cells = Mapping[tuple[Any, ...], Rows]  # by method and target
STAGES = ("simulation", "training", "design", "scoring", "update")
NUM_DRAWS = 2_000  # behind the share of a belief that is denser than the truth


def drawn_truth(task: Any, seed: int) -> Any:
    """Return a task with a truth that a seed draws from the prior."""
    with forked_generators(seed, "truth"):
        return task.with_truth(task.prior.sample((1,))[0])


def known_truth(belief: Any, truth: Tensor, draws: Tensor) -> dict[str, object]:
    """Return what a belief says of the truth.

    "hpd" is the share of the belief that is denser than the truth: the truth is in the
    region of highest density of level c where this is below c.
    """
    log_p = float(belief.log_prob(truth))
    return {
        "theta_true": " ".join(f"{v:.6g}" for v in truth.tolist()),
        "log_prob_true": log_p,
        "hpd": float((belief.log_prob(draws) > log_p).double().mean()),
    }


def last_round(
    campaign: Campaign, truth: Tensor, stages: Sequence[str] = STAGES
) -> tuple[dict[str, object], Tensor]:
    """Return the figures that all campaigns have of a round, and draws of its belief.

    Args:
        campaign: After the round.
        truth: Shape (theta_dim,).
        stages: Stages of a round whose time is told.
    """
    trial, belief = campaign.history[-1], campaign.belief
    assert trial.design is not None
    with forked_generators(derive_seed(trial.index, "draws")):
        draws = belief.sample((NUM_DRAWS,))
    gain = trial.design.expected_information_gain
    row = known_truth(belief, truth, draws) | {
        "eig": float(gain[trial.design.index]),
        "num_simulations": trial.num_simulations,
    }
    for stage in stages:
        row[f"cpu_{stage}"] = trial.cpu_seconds.get(stage, 0.0)
        row[f"wall_{stage}"] = trial.seconds.get(stage, 0.0)
    return row, draws


def played(
    task: Any,
    seed: int,
    num: int,
    *,
    method: str = "asbi",
    options: Any = None,
    executed: Callable[[Tensor, int], Tensor] | None = None,
) -> Iterator[tuple[Campaign, float]]:
    """Yield a campaign after each of its rounds, with the CPU seconds of the round.

    Args:
        task: What is asked, with ``real_system(action, seed=)``.
        seed: Seed of the campaign.
        num: Number of rounds.
        method: Name of the method.
        options: Of the campaign.
        executed: Function of an action and the trial's seed to what the robot does;
            what it was asked by default.
    """
    own = {"method": method, "seed": seed, "options": options}
    campaign = Campaign(task.simulator, task.prior, task.actions, **own)
    for index in range(num):
        start = time.process_time()
        trial, real = campaign.ask(), derive_seed(seed, "real", index)
        action = executed(trial.action, real) if executed else None
        asked = trial.action if action is None else action
        campaign.tell(task.real_system(asked, seed=real), action=action)
        campaign.update()
        yield campaign, time.process_time() - start


def cells_of(rows: Rows) -> Cells:
    """Return the rows of each method and target."""
    return grouped(rows, "method", "target")


def num_rounds(rows: Rows) -> int:
    """Return the number of rounds of the trials."""
    return max(int(r["round"]) for r in rows)


def by_round(rows: Rows, key: str) -> list[np.ndarray]:
    """Return a column, an array a round."""
    return [column(rows, key, k + 1) for k in range(num_rounds(rows))]


def active_against_random(
    cells: Cells, pairs: Sequence[tuple[str, str]] = (("asbi", "nsbi"),)
) -> list[str]:
    """Return how far the chosen actions' median log p is above the random ones'."""
    lines = []
    for active, random in pairs:
        for target in ("1", "2"):
            if (active, target) not in cells or (random, target) not in cells:
                continue
            ours, theirs = (
                [np.median(v) for v in by_round(cells[method, target], "log_prob_true")]
                for method in (active, random)
            )
            gaps = [a - b for a, b in zip(ours[1:], theirs[1:], strict=False)]
            text = " / ".join(f"{gap:+.2f}" for gap in gaps)
            lines.append(
                f"target {target}: {active.upper()} above {random.upper()} in median "
                f"log p in {sum(gap > 0 for gap in gaps)} of rounds 2 to {len(ours)} "
                f"({text})"
            )
    return lines


def coverage_table(
    cells: Cells, rounds: Sequence[int], last: tuple[str, Callable[[Rows, int], str]]
) -> str:
    """Return how often the truth lies in regions of highest density, by round.

    Args:
        cells: Rows by method and target.
        rounds: Rounds that are shown, where there are so many.
        last: Header of the last column, and the function of its cells.
    """
    table = []
    for (method, _), rows in cells.items():
        for number in [r for r in rounds if r <= num_rounds(rows)]:
            hpd = column(rows, "hpd", number)
            n, entry = len(hpd), [method.upper(), str(number), str(len(hpd))]
            for level in (0.5, 0.9):
                inside = int((hpd <= level).sum())
                low, high = stats.binom.interval(0.95, n, level)
                verdict = "within" if low <= inside <= high else "outside"
                bounds = f"[{low / n:.3f}, {high / n:.3f}]"
                entry.append(f"{inside / n:.3f} {verdict} {bounds}")
            table.append([*entry, last[1](rows, number)])
    header = ["", "round", "trials", "in 50 % region", "in 90 % region", last[0]]
    return Table(header, table).text() if table else "no trials yet"
