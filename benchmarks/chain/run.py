"""Beliefs of a chain's 8 to 20 parameters beside a long tempered SMC.

    python -m benchmarks chain --parameters 8 12 16 20 --seeds 2300 2340
    python -m benchmarks chain --summary

Each seed has a truth drawn from the prior and six trials at random actions, refined
with the defaults but for a defensive share of 1e-6, since one draw of the prior among
20,000 dominates the moments of a sharp posterior. "kl" is the divergence between normal
fits to the logarithms of draws, from the reference to the belief; "kl_error" the same
between two seeds of the reference. "density_rank" is the share of draws whose density
is below that of the truth: the smallest 90 % region holds it where that is at least .1,
one answer a truth. "covered" counts parameters within their central 90 % interval; of
one truth they go together, so that its interval has the truths' spread, not that of as
many coins. Seeds 2200 to 2238 were judged before modes were searched as they are. CPU
time is that of the refinement, and "simulator_s" what the same rows cost the simulator
alone. Rows are added to results/, and those that are there are not run again.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import binom, t
from torch import Tensor

from benchmarks.rounds import drawn_truth
from benchmarks.rows import benchmark, frame
from sbi_active import RefinementOptions
from sbi_active.display.table import Table
from sbi_active.inference import refine
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.tasks import get_task  # pyright: ignore

RESULTS = Path(__file__).with_name("results")
NUM_TRIALS, NUM_DRAWS, NUM_RANKED, LEVEL = 6, 20_000, 1_000, 0.9
REFERENCES = 2302  # seeds below have a reference


def problem(parameters: int, seed: int) -> tuple[Any, Tensor, Tensor]:
    """Return a task with a drawn truth, its actions and outcomes."""
    task = drawn_truth(get_task("chain", parameters=parameters), seed)
    action = task.actions.sample((NUM_TRIALS,), seed=derive_seed(seed, "actions"))
    x = [task.real_system(a, seed=derive_seed(seed, i)) for i, a in enumerate(action)]
    return task, action, torch.stack(x)


def divergence(one: Tensor, other: Tensor) -> float:
    """Return KL of normal fits to the logarithms of draws, both (n, d)."""
    a, b = (draws.double().log().numpy() for draws in (one, other))
    cov_a, cov_b = np.cov(a.T), np.cov(b.T)
    apart = b.mean(0) - a.mean(0)
    solved = np.linalg.solve(cov_b, np.column_stack([cov_a, apart]))
    logs = np.linalg.slogdet(cov_b)[1] - np.linalg.slogdet(cov_a)[1]
    trace = np.trace(solved[:, :-1])
    return float(0.5 * (trace + apart @ solved[:, -1] - a.shape[1] + logs))


def simulator_seconds(task: Any, num: int) -> float:
    """Return CPU seconds that so many rows cost the simulator alone."""
    theta = task.prior.sample((1_000,))
    action = task.actions.sample((1_000,), seed=0)
    start = time.process_time()
    task.simulator.mean(theta, action)
    return (time.process_time() - start) * num / 1_000


def judged(parameters: int, seed: int) -> dict[str, Any]:
    task, action, x = problem(parameters, seed)
    start = time.process_time()
    settings = RefinementOptions(defensive=1e-6)
    belief = refine(task.simulator, task.prior, action, x, settings=settings, seed=seed)
    seconds = time.process_time() - start
    with forked_generators(seed, "draws"):
        draws = belief.sample(torch.Size([NUM_DRAWS]))
    tail = (1 - LEVEL) / 2
    low, high = draws.quantile(torch.tensor([tail, 1 - tail]), dim=0)
    covered = int(((task.theta_true >= low) & (task.theta_true <= high)).sum())
    log_p = belief.log_prob(torch.cat([task.theta_true[None], draws[:NUM_RANKED]]))
    d = belief.diagnostics
    row: dict[str, Any] = {
        "method": type(belief).__name__,
        "covered": covered,
        "density_rank": float((log_p[1:] < log_p[0]).double().mean()),
        "log_prob_truth": float(log_p[0]),
        "trustworthy": bool(d.trustworthy),
        "cpu_s": seconds,
        "simulator_s": simulator_seconds(task, d.num_simulations),
        "num_simulations": d.num_simulations,
        "num_uninformed": d.figures.get("num_uninformed", 0),
        "kl": np.nan,
        "kl_error": np.nan,
        "evidence_gap": np.nan,
        "reference_cpu_s": np.nan,
    }
    if seed < REFERENCES:
        start = time.process_time()
        one, other = (
            task.reference(action, x, seed=derive_seed(seed, "reference", i))
            for i in range(2)
        )
        row["reference_cpu_s"] = time.process_time() - start
        both = torch.cat([one.draws, other.draws])
        row["kl"] = divergence(both, draws)
        row["kl_error"] = divergence(one.draws, other.draws)
        evidence = 0.5 * (one.log_evidence + other.log_evidence)
        row["evidence_gap"] = d.figures.get("log_evidence", np.nan) - evidence
    return row


def summary(rows: list[dict[str, Any]]) -> str:
    """Return a line for each number of parameters."""
    lines = []
    for dim, part in frame(rows).groupby("parameters"):
        known = part.dropna(subset="kl")
        share, n = part["covered"] / int(dim), len(part)  # pyright: ignore
        off = t.ppf(0.975, n - 1) * share.std() / n**0.5 if n > 1 else np.nan
        held = int(np.sum(part["density_rank"].to_numpy() >= 1 - LEVEL))
        low, high = binom.ppf([0.025, 0.975], n, LEVEL).astype(int)
        lines.append(
            {
                "parameters": dim,
                "truths": len(part),
                "median KL": f"{known['kl'].median():.3f}",
                "largest KL": f"{known['kl'].max():.3f}",
                "its error": f"{known['kl_error'].median():.3f}",
                "references": len(known),
                "in 90 % regions": f"{held} of {n}",
                "by chance": f"{low} to {high}",
                "in 90 % intervals": f"{share.mean():.3f} +- {off:.3f}",
                "trustworthy": f"{part['trustworthy'].mean():.2f}",
                "CPU s": f"{part['cpu_s'].median():.2f}",
                "simulator's": f"{part['simulator_s'].median():.2f}",
            }
        )
    return Table([*lines[0]], [[*map(str, line.values())] for line in lines]).text()


main = benchmark(
    RESULTS / "beliefs.csv",
    judged,
    summary,
    parameters=(8, 12, 16, 20),
    seed=range(2300, 2340),
)
