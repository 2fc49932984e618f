"""Table 1 of the paper: five methods on the numerical model, at equal simulations.

    python -m benchmarks numerical.methods --setting faithful
    python -m benchmarks numerical.methods --setting default --method asbi alhi

Every simulation counts: to train on, for the information gain, to refine a belief and
to score a trial. "faithful" has each method as its authors do, 54,000 simulations a
round. "default" has this library's defaults, 24,000 to 25,000 a round, those of the
adaptive parts measured and not fixed; the method SeqBED is then the amortized one. A
method that draws its actions at random trains on what the others spend on designing.

Actions are scored by the exact information gain lost (regret), under the exact
posterior of the same trials; beliefs by the log density of the truth, its gap to the
exact posterior's, the reproduction error and a classifier test against draws of the
exact posterior (.5 is perfect, 1 tells all draws apart).

Resumable: a trial that stands in the CSV is not run again. One row a round, one file a
method and setting, in benchmarks/numerical/results.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from attrs import evolve
from sbi.utils.metrics import c2st
from torch import Tensor

from benchmarks.numerical.run import (
    NUM_ROUNDS,
    REPORTED,
    RESULTS,
    STAGES,
    errors,
    exact_limits,
    make_task,
    medians,
    reference,
)
from benchmarks.numerical.run import run_trial as by_round
from benchmarks.rows import benchmark, column, grouped, published
from sbi_active import Campaign, CampaignOptions
from sbi_active.campaign.learning.methods import METHODS
from sbi_active.campaign.options import CampaignDetails
from sbi_active.display.table import Table
from sbi_active.inference import LFIRE
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.tasks import Task

NUM_COMPARED = 1_000  # draws of each in the classifier test
#: Of a round in the faithful setting, and in the default one for designing alone.
NUM_FAITHFUL, NUM_DESIGN = 52_000, 15_700


_ALHI: dict[str, Any] = {
    "estimator": "likelihood",
    "details": CampaignDetails(posterior="kde", eliminate=False),
}
#: Options of each method's authors that differ from those of the paper's setting.
#: LFIRE learns from 52,000 simulations a round, as many as the others take in all.
FAITHFUL: dict[str, dict[str, Any]] = {
    "asbi": {},
    "nsbi": {},
    "alhi": _ALHI,
    "nlhi": _ALHI,
    "seqbed": {
        "estimator": "ratio",
        "density_estimator": LFIRE(),
        "num_simulations": 41_500,
        "num_samples": 500,
    },
}


def options_of(setting: str, method: str) -> CampaignOptions:
    """Return a method's options, such that totals of simulations are alike.

    Faithful is :meth:`.CampaignOptions.faithful` for ASBI and NSBI; ALHI and NLHI have
    the same network on x given (theta, action), beliefs by kernel density estimation
    and nested Monte Carlo for the gain; SeqBED has LFIRE, at the same total.
    """
    designs = METHODS[method].designs
    if setting == "faithful":
        options = evolve(CampaignOptions.faithful(), **FAITHFUL[method])
        return options if designs else evolve(options, num_simulations=NUM_FAITHFUL)
    options = CampaignOptions()
    if not designs:
        num = options.num_simulations + NUM_DESIGN
        options = evolve(options, num_simulations=num)
    return options


def rows_of(setting: str, method: str, seed: int) -> list[dict[str, Any]]:
    """Return one row a round of one campaign."""
    task = make_task("linear", "fixed", seed)
    made = by_round(task, method, options_of(setting, method), seed)
    return [
        row | {"c2st": compared(task, campaign, index)}
        for index, (row, campaign) in enumerate(made)
    ]


def compared(task: Task, campaign: Campaign, index: int) -> Tensor | str:
    """Return how well draws of the last belief are told from exact ones, else ""."""
    if index + 1 < NUM_ROUNDS:
        return ""
    exact = reference(task, campaign.history).sample(NUM_COMPARED, seed=index).float()
    with forked_generators(derive_seed(index, "c2st")):
        draws = campaign.belief.sample((NUM_COMPARED,))
    # The posterior is a thin ridge: whitened, so that no axis hides it.
    factor = torch.linalg.cholesky(torch.cov(exact.double().T))
    pair = [
        torch.linalg.solve_triangular(factor, each.double().T, upper=False).T.float()
        for each in (exact, draws)
    ]
    return c2st(*pair, seed=1)


def summary(name: str, rows: list[dict[str, str]]) -> list[str]:
    """Return the table's row of a method."""
    last = NUM_ROUNDS
    gap = column(rows, "gap", last)
    regret = [column(rows, "regret", r + 1).mean() for r in range(last)]
    cpu = sum(column(rows, f"cpu_{stage}").mean() for stage in STAGES)
    return [
        f"{name} ({len(gap)})",
        medians(rows, "log_prob_true", last),
        *errors(rows, last),
        f"{np.median(gap):.2f} {gap.mean():.2f}",
        " / ".join(f"{r:.2f}" for r in regret),
        f"{np.median(column(rows, 'c2st', last)):.2f}",
        f"{column(rows, 'num_simulations').mean():.0f}",
        f"{cpu:.1f}",
    ]


def table(rows: list[dict[str, str]]) -> str:
    """Return a table of each setting."""
    parts, beside = [], published("numerical") | exact_limits()
    for (setting,), found in grouped(rows, "setting").items():
        lines = [summary(m, own) for (m,), own in grouped(found, "method").items()]
        lines += [[k, *v, *[""] * 5] for k, v in beside.items()]
        header = [f"{setting} (trials)", "median log p(truth), round 1 / 2 / .."]
        header += [f"RepErr({a:g})" for a in REPORTED]
        header += ["gap: median mean", "mean regret, round 1 / 2 / ..", "C2ST"]
        header += ["simulations a round", "CPU s a round"]
        parts.append(Table(header, lines).text())
    return "\n\n".join(parts)


main = benchmark(
    RESULTS / "methods_{setting}_{method}.csv",
    rows_of,
    table,
    default={"setting": ("default",)},
    setting=("faithful", "default"),
    method=METHODS,
    seed=range(10),
)
