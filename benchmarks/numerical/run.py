"""Campaigns on tasks with exact inference, beside the paper and the exact limit.

    python -m benchmarks numerical                       # theta_true = (-3, 1)
    python -m benchmarks numerical --truth random --seeds 0 40 --setting default
    python -m benchmarks numerical --task sinh --setting default --method asbi
    python -m benchmarks numerical --task oscillator --setting default default_500

Resumable: a trial that stands in the CSV is not run again. One row a round, one file a
setting, in benchmarks/numerical/results; the table is printed at the end.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from attrs import evolve
from torch import Tensor

from benchmarks.rounds import drawn_truth, last_round, played
from benchmarks.rows import benchmark, column, grouped, published, read
from sbi_active import Campaign, CampaignOptions, RefinementOptions
from sbi_active.campaign import Trial
from sbi_active.display.table import Table
from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.tasks import Task, get_task

RESULTS = Path(__file__).parent / "results"
REPORTED = (-3.0, 0.0, 3.0)  # actions of the paper's Table 1
SETTINGS: dict[str, CampaignOptions] = {
    "faithful": CampaignOptions.faithful(),
    "default": CampaignOptions(),
    "default_500": evolve(
        CampaignOptions(), refinement=RefinementOptions(num_histories=500)
    ),
}
NUMERICAL = ("linear", "sinh", "square")
STAGES = ("simulation", "training", "design", "update")
NUM_ROUNDS = 4
#: Relative error of executed actions, and the end of the names of tasks that have it.
JITTER, JITTERED = 0.1, "_jittered"


def make_task(name: str, truth: str, seed: int) -> Task:
    """Return the task with the paper's truth or one drawn from the prior."""
    task = get_task("numerical", variant=name) if name in NUMERICAL else get_task(name)
    return task if truth == "fixed" else drawn_truth(task, seed)


def reference(task: Task, trials: Sequence[Trial]) -> Any:
    """Return exact inference after the trials."""
    dim = task.actions.action_dim
    if not trials:
        return task.reference(torch.empty(0, dim), torch.empty(0, 1))
    x = torch.stack([t.x for t in trials if t.x is not None])
    return task.reference(torch.stack([t.action for t in trials]), x)


def run_trial(
    task: Task,
    method: str,
    options: CampaignOptions,
    seed: int,
    *,
    jitter: float = 0.0,
) -> Iterator[tuple[dict[str, object], Campaign]]:
    """Yield the row of each round of one campaign, and the campaign.

    Args:
        task: What is asked.
        method: Name of the method.
        options: Of the campaign.
        seed: Its seed.
        jitter: Relative error of executed actions.
    """

    def executed(action: Tensor, seed: int) -> Tensor:
        if not jitter:
            return action
        # The robot does not do quite what it was asked.
        generator = torch.Generator().manual_seed(seed)
        return action * (1 + jitter * torch.randn(action.shape, generator=generator))

    own = {"method": method, "options": options, "executed": executed}
    for index, (campaign, _) in enumerate(played(task, seed, NUM_ROUNDS, **own)):
        gain = None
        if task.name == "numerical":
            before = reference(task, campaign.history[:-1])
            gain = before.expected_information_gain(task.actions.values)
        row = {"round": index + 1} | round_row(task, campaign, gain, index)
        yield row, campaign


def round_row(
    task: Task, campaign: Campaign, gain: Tensor | None, index: int
) -> dict[str, object]:
    """Return the figures of the last round."""
    trial, belief = campaign.history[-1], campaign.belief
    assert trial.design is not None
    exact, truth = reference(task, campaign.history), task.theta_true
    log_p = float(exact.log_prob(truth[None].double())[0])
    row, _ = last_round(campaign, truth, STAGES)
    exact_draws = exact.sample(2_000, seed=index)
    exact_log_p = exact.log_prob(exact_draws)
    chosen = trial.design.index
    diagnostics = getattr(belief, "diagnostics", Diagnostics()).to_dict()
    row |= {
        "action": " ".join(f"{v:g}" for v in trial.action.tolist()),
        "gap": log_p - float(belief.log_prob(truth)),
        "kl": float((exact_log_p - belief.log_prob(exact_draws.float())).mean()),
        "exact_hpd": float((exact_log_p > log_p).double().mean()),
        "trustworthy": diagnostics.get("trustworthy"),
    }
    if gain is not None:
        row["regret"] = gain.max() - gain[chosen]
        row |= {f"rep_err_{a:g}": task.reproduction_error(belief, a) for a in REPORTED}
    return row


def rows_of(
    name: str, truth: str, setting: str, method: str, seed: int
) -> list[dict[str, object]]:
    """Return one row a round of one campaign."""
    task = make_task(name.removesuffix(JITTERED), truth, seed)
    jitter = JITTER if name.endswith(JITTERED) else 0.0
    made = run_trial(task, method, SETTINGS[setting], seed, jitter=jitter)
    return [row for row, _ in made]


def exact_limits() -> dict[str, tuple[str, ...]]:
    """Return rows of the exact posterior, its actions exact or at random."""
    found = {}
    for way in ("exact", "random"):
        rows = [r for r in read(RESULTS / "exact.csv") if r["actions"] == way]
        medians = [np.median(column(rows, f"log_prob_{r + 1}")) for r in range(4)]
        errors = [column(rows, f"rep_err_{action:g}") for action in REPORTED]
        found[f"exact posterior, {way} actions ({len(rows)})"] = (
            " / ".join(f"{m:.2f}" for m in medians),
            *(f"{error.mean():.3g} +- {error.std():.2g}" for error in errors),
        )
    return found


def medians(rows: list[dict[str, str]], key: str, rounds: int) -> str:
    """Return the median of a column by round."""
    each = [np.median(column(rows, key, r + 1)) for r in range(rounds)]
    return " / ".join(f"{m:.2f}" for m in each)


def errors(rows: list[dict[str, str]], last: int) -> list[str]:
    """Return mean and deviation of the errors of reproduction."""
    each = [column(rows, f"rep_err_{action:g}", last) for action in REPORTED]
    return [f"{error.mean():.3g} +- {error.std():.2g}" for error in each]


def summary(name: str, rows: list[dict[str, str]]) -> list[str]:
    """Return the table's row of a setting."""
    last = max(int(r["round"]) for r in rows)
    gap, kl = column(rows, "gap", last), column(rows, "kl", last)
    hpd, exact_hpd = column(rows, "hpd", last), column(rows, "exact_hpd", last)
    regret = [column(rows, "regret", r).mean() for r in (1, 2)]
    cpu = sum(column(rows, f"cpu_{stage}").mean() for stage in STAGES)
    return [
        f"{name} ({len(gap)})",
        medians(rows, "log_prob_true", last),
        f"{np.median(gap):.2f} {gap.mean():.2f} {np.percentile(gap, 95):.2f}",
        f"{np.median(kl):.3f}",
        f"{regret[0]:.2f} / {regret[1]:.2f}",
        f"{np.mean(hpd < 0.5):.2f} {np.mean(hpd < 0.9):.2f}",
        f"{np.mean(exact_hpd < 0.5):.2f} {np.mean(exact_hpd < 0.9):.2f}",
        *errors(rows, last),
        f"{column(rows, 'num_simulations').mean():.0f}, {cpu:.2f}",
    ]


def table(rows: list[dict[str, str]]) -> str:
    """Return a table of each task and truth."""
    parts = []
    for (name, truth), found in grouped(rows, "task", "truth").items():
        task = name.removesuffix(JITTERED)
        lines = [
            summary(f"{setting}, {method.upper()}", own)
            for (setting, method), own in grouped(found, "setting", "method").items()
        ]
        header = [f"{task}, truth {truth} (trials)"]
        header += ["median log p(truth), round 1 / 2 / ..", "gap: median mean 95 %"]
        header += ["median KL", "regret r1 / r2", "in 50, 90 % region", "(exact's own)"]
        header += [f"RepErr({a:g})" for a in REPORTED]
        header += ["simulations, CPU s a round"]
        if truth == "fixed" and task == "linear":
            beside = published("numerical") | exact_limits()
            lines += [[k, v[0], *[""] * 5, *v[1:], ""] for k, v in beside.items()]
        parts.append(Table(header, lines).text())
    return "\n\n".join(parts)


main = benchmark(
    RESULTS / "{task}_{truth}_{setting}_{method}.csv",
    rows_of,
    table,
    default={
        "task": ("linear",),
        "truth": ("fixed",),
        "setting": ("faithful", "default"),
    },
    task=(*NUMERICAL, "oscillator", "oscillator" + JITTERED),
    truth=("fixed", "random"),
    setting=SETTINGS,
    method=("asbi", "nsbi"),
    seed=range(20),
)
