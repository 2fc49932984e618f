"""The paper's box collision: log p(truth), reproduction error, speeds, time a round.

    python -m benchmarks box_collision                       # both targets, 10 trials
    python -m benchmarks box_collision --seeds 0 50          # the paper's number
    python -m benchmarks box_collision --setting learned --method asbi nsbi alhi nlhi
    python -m benchmarks box_collision --setting coverage --target prior --seeds 0 40
    python -m benchmarks box_collision --summary

Resumable: a trial that stands in the CSV is not run again. One row a round, one file a
method, target and setting, in ``results``; tables are printed at the end.

"coverage": truths from the prior, three rounds, and how often regions hold them.
Beside a belief stands the posterior of the same trials by importance sampling
(``log_p_exact``, with its standard error), which is what the best inference would
reach with these actions. It needs noise: without any, as in the paper, there is no
posterior density.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from attrs import evolve
from torch import Tensor

from benchmarks import rounds
from benchmarks.numerical.methods import FAITHFUL
from benchmarks.rows import benchmark, column, grouped, published
from sbi_active import Campaign, CampaignOptions
from sbi_active.campaign.learning.methods import METHODS
from sbi_active.campaign.options import CampaignDetails
from sbi_active.display.table import Table
from sbi_active.seeding import derive_seed
from sbi_active.tasks import get_task
from sbi_active.tasks.box_collision import BoxCollisionReference, exact_posterior  # pyright: ignore

REPORTED = (3.0, 5.0, 7.0)  # m/s
PARTS = {  # of a round, in the paper's words
    "simulation": ("simulation",),
    "training": ("training",),
    "information gain": ("design",),
    "refinement": ("scoring", "update"),
}
#: Table 2: mean and standard deviation of 50 trials, 1e-3 m, at 3, 5 and 7 m/s.
PUBLISHED = published("box collision")
#: Mean speeds of rounds 1 and 6, and seconds a round.
PUBLISHED_SPEEDS = published("box collision speeds")
(PUBLISHED_TIME,) = published("box collision time")["a round"]

#: Of the reference's log p, nats, above which importance sampling has failed.
LARGEST_ERROR = 0.5
PAIRS = (("asbi", "nsbi"), ("alhi", "nlhi"))  # chosen and random actions


def table(rows: rounds.Rows) -> str:
    """Return the tables of each setting, the paper's figures beside ours."""
    parts: list[str] = []
    for (setting,), found in grouped(rows, "setting").items():
        cells = rounds.cells_of(found)
        if setting == "coverage":
            parts.append(rounds.coverage_table(cells, (3,), ("gap", gap)))
            continue
        parts += [errors_table(cells), rounds_table(cells), time_table(cells)]
        parts += rounds.active_against_random(cells, PAIRS)
    return "\n\n".join(parts) or "no trials yet"


def errors_table(cells: rounds.Cells) -> str:
    """Return Table 2: the reproduction errors of the last belief."""
    table = []
    for (method, target), rows in cells.items():
        last = rounds.num_rounds(rows)
        published = PUBLISHED.get(f"{method} {target}", ("-",) * len(REPORTED))
        trials = len(column(rows, "log_prob_true", last))
        entry = [f"target {target}", method.upper(), str(trials)]
        for speed, paper in zip(REPORTED, published, strict=True):
            ours = column(rows, f"rep_err_{speed:g}", last)
            limit = known(rows, f"exact_rep_err_{speed:g}", last)
            entry += [spread(ours), spread(limit), paper]
        table.append(entry)
    header = ["", "method", "trials"]
    for speed in REPORTED:
        header += [f"RepErr({speed:g}), 1e-3", "exact posterior's", "paper"]
    return Table(header, table).text()


def rounds_table(cells: rounds.Cells) -> str:
    """Return Figures 7 and 8 in numbers, and the gap to the exact posterior."""
    table = []
    for (method, target), rows in cells.items():
        last = rounds.num_rounds(rows)
        medians = [np.median(v) for v in rounds.by_round(rows, "log_prob_true")]
        speeds = [v.mean() for v in rounds.by_round(rows, "speed")]
        shares = [1 - v.mean() for v in rounds.by_round(rows, "is_valid")]
        table.append(
            [
                f"target {target}, {method.upper()}",
                " / ".join(f"{m:.2f}" for m in medians),
                gap(rows, last),
                " / ".join(f"{s:.1f}" for s in speeds),
                *PUBLISHED_SPEEDS.get(f"{method} {target}", ("-",)),
                " / ".join(f"{s:.2f}" for s in shares),
            ]
        )
    header = ["", "median log p(truth) by round", "gap: mean +- se, 95 % (se of exact)"]
    return Table([*header, "mean speed", "paper", "share off the table"], table).text()


def time_table(cells: rounds.Cells) -> str:
    """Return Figure 9 in numbers: what a round costs."""
    table = []
    for (method, target), rows in cells.items():
        entry = [f"target {target}, {method.upper()}"]
        for kind in ("cpu", "wall"):
            seconds = time_parts(rows, kind)
            cells_ = [f"{s:.1f}" for s in seconds.values()]
            entry.append(f"{sum(seconds.values()):.1f} ({' + '.join(cells_)})")
        entry.append(f"{column(rows, 'num_simulations').mean():.0f}")
        table.append(entry)
    names = " + ".join(PARTS)
    header = ["", f"CPU s a round ({names})", "wall s", "simulations a round"]
    return f"{Table(header, table).text()}\npaper, ASBI: {PUBLISHED_TIME}"


def time_parts(rows: rounds.Rows, kind: str) -> dict[str, float]:
    """Return mean seconds a round by part."""
    return {
        part: float(sum(column(rows, f"{kind}_{s}").mean() for s in stages))
        for part, stages in PARTS.items()
    }


def gap(rows: rounds.Rows, round_: int) -> str:
    """Return the gap to the exact posterior: mean, its error, 95th percentile.

    Of trials whose reference is known well enough; how many are not is said.
    """
    every = np.isfinite(column(rows, "gap", round_)).sum()
    values = known(rows, "gap", round_)
    lost = f", {every - len(values)} of {every} unknown" if len(values) < every else ""
    if not len(values):
        return f"-{lost}"
    error = values.std(ddof=1) / len(values) ** 0.5 if len(values) > 1 else np.nan
    exact = known(rows, "log_p_exact_se", round_).max()
    percentile = np.percentile(values, 95)
    return f"{values.mean():.2f} +- {error:.2f}, {percentile:.2f} ({exact:.2f}){lost}"


def known(rows: rounds.Rows, key: str, round_: int) -> Any:
    """Return the reference's column where its log p is known within .5 nats."""
    values = column(rows, key, round_)
    return values[column(rows, "log_p_exact_se", round_) <= LARGEST_ERROR]


def spread(values: Any) -> str:
    """Return mean and standard deviation."""
    values = values[np.isfinite(values)]
    return f"{values.mean():.1f} +- {values.std():.1f}" if len(values) else "-"


OPTIONS = CampaignOptions(num_samples=250, details=CampaignDetails(num_scored=500))
#: "learned" has beliefs and information by the networks alone, which is where the
#: methods differ: by default the declared noise gives both, whatever was learned.
SETTINGS = {
    "default": OPTIONS,
    "learned": evolve(OPTIONS, refine=False),
    "coverage": OPTIONS,
}
NUM_ROUNDS = {"default": 6, "learned": 6, "coverage": 3}
NUM_PARTICLES = 100  # effective draws of the reference


class Resampled:
    """Draws of a weighted sample, as the task's metrics take a belief."""

    def __init__(self, posterior: BoxCollisionReference) -> None:
        self._posterior = posterior

    def sample(self, shape: torch.Size) -> Tensor:
        """Return draws, shape (n, 3)."""
        seed = int(torch.randint(2**31, ()))
        return self._posterior.sample(shape[0], seed=seed)


def rows_of(
    setting: str, method: str, target: str, seed: int
) -> list[dict[str, object]]:
    """Return one row a round of one campaign, the reference in the default's last."""
    task, num = make_task(target, seed), NUM_ROUNDS[setting]
    rows: list[dict[str, object]] = []
    options = options_of(method, setting)
    made = rounds.played(task, seed, num, method=method, options=options)
    for index, (campaign, _) in enumerate(made):
        is_last = index + 1 == num
        row = round_row(task, campaign, is_last=is_last)
        if is_last and setting == "default":
            exact = exact_posterior(
                task,
                campaign.history,
                num_particles=NUM_PARTICLES,
                seed=derive_seed(seed, "reference"),
            )
            log_q = float(campaign.belief.log_prob(task.theta_true))
            log_p = float(exact.log_prob(task.theta_true[None])[0])
            row |= {"log_p_exact_se": exact.log_evidence_se, "gap": log_p - log_q}
            row |= errors(task, Resampled(exact), "exact_rep_err")
        rows.append({"round": index + 1} | row)
    return rows


def options_of(method: str, setting: str) -> CampaignOptions:
    """Return a setting's options, with what is the method's own in them."""
    own = FAITHFUL[method]
    if setting == "learned":
        estimator = own.get("estimator", "posterior")
        return evolve(SETTINGS[setting], estimator=estimator)
    return SETTINGS[setting]


def round_row(task: Any, campaign: Campaign, *, is_last: bool) -> dict[str, object]:
    """Return the figures of the last round, without the reference's."""
    trial = campaign.history[-1]
    row = rounds.last_round(campaign, task.theta_true)[0] | {
        "speed": float(trial.action),
        "is_valid": int(trial.status == "ok"),
    }
    return row | (errors(task, campaign.belief, "rep_err") if is_last else {})


def errors(task: Any, belief: Any, name: str) -> dict[str, object]:
    """Return the reproduction errors, 1e-3 m, N = 250 as in the paper."""
    table = task.reproduction_table(belief)
    return {f"{name}_{speed:g}": table[speed] for speed in REPORTED}


def make_task(target: str, seed: int) -> Any:
    """Return a target of the paper, or a truth drawn from the prior."""
    if target != "prior":
        return get_task("box_collision", target=int(target))
    return rounds.drawn_truth(get_task("box_collision"), seed)


main = benchmark(
    Path(__file__).parent / "results" / "{setting}_target_{target}_{method}.csv",
    rows_of,
    table,
    skip=lambda setting, method, target, seed: (
        (setting == "coverage") != (target == "prior")
    ),
    default={
        "setting": ("default",),
        "target": ("1", "2"),
        "method": ("asbi", "nsbi"),
    },
    setting=SETTINGS,
    method=METHODS,
    target=("1", "2", "prior"),
    seed=range(10),
)
