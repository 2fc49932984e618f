"""Source location finding: information gained in T trials, by policy.

    python -m benchmarks location_finding --policy random fixed myopic_particles
    python -m benchmarks location_finding --policy myopic --rollouts 0 16
    python -m benchmarks location_finding --summary

One row a roll-out, in rows.csv beside this file. Roll-out i has the same truth, noise
and contrastive draws under every policy, so that policies are compared on paired
roll-outs. The table: policies, paired differences, published figures.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.location_finding.bounds import (
    CLOSE,
    contrastive_bounds,
    history_log_likelihood,
    posterior_bounds,
)
from benchmarks.location_finding.policies import POLICIES, Myopic, ParticleBelief
from benchmarks.rounds import drawn_truth
from benchmarks.rows import Row, benchmark, grouped, published
from sbi_active.display.table import Table
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.tasks import get_task

NUM_CONTRASTIVE = 500_000  # L

Rows = dict[int, dict[str, float]]  # by roll-out

NAMES = {
    "random": "random",
    "fixed": "fixed, optimized",
    "myopic": "myopic, refined belief (ASBI)",
    "myopic_particles": "myopic, particles (exact likelihood)",
}
#: sPCE and sNMC, 30 trials, 2,048 roll-outs, as reported by Foster et al. (2021).
PUBLISHED = published("location finding")
BOUNDS = ("spce", "snmc", "lower", "upper")
COSTS = ("cpu_design", "cpu_belief", "cpu_bounds")


def by_rollout(rows: Sequence[Row]) -> Rows:
    """Return the numbers of a policy's roll-outs."""
    keys = (*BOUNDS, *COSTS, "effective", "belief_gain")
    return {
        int(row["rollout"]): {key: float(row.get(key) or "nan") for key in keys}
        for row in rows
    }


def mean_and_error(values: np.ndarray) -> tuple[float, float]:
    """Return the mean over roll-outs and its standard error; nan for one roll-out."""
    if len(values) < 2:
        return float(values.mean()), float("nan")
    return float(values.mean()), float(values.std(ddof=1) / len(values) ** 0.5)


def difference(
    better: Rows, worse: Rows, low: str = "lower", high: str = "upper"
) -> tuple[float, float, int]:
    """Return a lower bound of one policy's lead over another, over paired roll-outs.

    That is the lower bound of the first less the upper bound of the second.

    Returns:
        Mean, standard error and the number of roll-outs that both have.
    """
    common = sorted(set(better) & set(worse))
    values = np.array([better[i][low] - worse[i][high] for i in common])
    return *mean_and_error(values), len(common)


def table(given: Sequence[Row]) -> str:
    """Return the table of each number of trials, and lines on paired differences."""
    by_trials = grouped(given, "trials")
    cap = math.log(NUM_CONTRASTIVE + 1)
    parts = [table_of(int(num), rows) for (num,), rows in by_trials.items()]
    return "\n".join([*parts, f"sPCE cannot exceed log(L + 1) = {cap:.2f} nats."])


def table_of(num_trials: int, given: Sequence[Row]) -> str:
    """Return the table of so many trials."""
    groups = grouped(given, "policy")
    policies = {p: by_rollout(groups[p,]) for p in NAMES if (p,) in groups}
    cells, lines = [], []
    for policy, rows in policies.items():
        columns = {k: np.array([r[k] for r in rows.values()]) for k in rows[min(rows)]}
        means = {k: mean_and_error(columns[k]) for k in BOUNDS}
        cpu = [f"{columns[k].mean():.1f}" for k in COSTS]
        bounds = [f"{mean:.2f} +- {error:.2f}" for mean, error in means.values()]
        cells.append([f"{NAMES[policy]} ({len(rows)})", *bounds, " / ".join(cpu)])
        if means["spce"][0] > math.log(NUM_CONTRASTIVE + 1) - CLOSE:
            lines.append(f"{policy}: sPCE is at its cap; sNMC rests on few draws")
        gap = columns["belief_gain"] - columns["lower"]
        if np.isfinite(gap).all():
            close = np.mean(np.abs(gap) < 0.5)
            lines.append(
                f"{policy}: log belief at the truth less the exact value, median "
                f"{np.median(gap):+.2f}, within .5 nat in {close:.2f} of the roll-outs"
            )
    for policy in [p for p in policies if p.startswith("myopic")]:
        for other in [p for p in ("random", "fixed") if p in policies]:
            for low, high in (("spce", "snmc"), ("lower", "upper")):
                mean, error, num = difference(
                    policies[policy], policies[other], low, high
                )
                lines.append(
                    f"{policy} {low} less {other} {high}: {mean:+.2f} +- {error:.2f} "
                    f"({num} paired roll-outs)"
                )
    if num_trials == 30:
        cells += [[name, *pair, "", "", ""] for name, pair in PUBLISHED.items()]
    header = [f"{num_trials} trials (roll-outs)", "sPCE", "sNMC", "lower", "upper"]
    header.append("CPU s: design / belief / bounds")
    return "\n".join([Table(header, cells).text(), *lines])


PARTICLES = 2_000  # of the posterior behind the proposal


def roll_out(policy: str, rollout: int, num_trials: int) -> dict[str, Any]:
    """Return the row of one roll-out.

    ``spce`` and ``snmc`` contrast with draws of the prior, ``lower`` and ``upper`` with
    draws of a proposal fitted to the posterior, of which ``effective`` count.
    ``belief_gain`` is what the policy's own belief says, log b - log p at the truth.

    Args:
        policy: One of ``POLICIES``.
        rollout: Its number, which gives truth, noise and contrastive draws.
        num_trials: T.
    """
    task = drawn_truth(get_task("location_finding"), rollout)
    player = POLICIES[policy](task, derive_seed(rollout, "policy"))
    seconds = {"design": 0.0, "belief": 0.0}
    for t in range(num_trials):
        start = time.process_time()
        action = player.choose()
        chosen = time.process_time()
        x = task.real_system(action, seed=derive_seed(rollout, "noise", t))
        player.tell(action, x)
        seconds["design"] += chosen - start
        seconds["belief"] += time.process_time() - chosen

    start = time.process_time()
    truth, action, x = task.theta_true, player.action, player.x
    with forked_generators(derive_seed(rollout, "contrastive")):
        contrastive = task.prior.sample(torch.Size([NUM_CONTRASTIVE]))
    log_p_true = history_log_likelihood(truth[None], action, x)
    log_p = history_log_likelihood(contrastive, action, x)
    spce, snmc = contrastive_bounds(log_p_true, log_p[None])
    particles = ParticleBelief(
        task, num_particles=PARTICLES, seed=derive_seed(rollout, "particles")
    )
    for place, value in zip(action, x, strict=True):
        particles.update(place, value)
    lower, upper, effective = posterior_bounds(
        particles.theta, action, x, truth, seed=derive_seed(rollout, "proposal")
    )
    row: dict[str, Any] = {
        "theta_true": " ".join(f"{v:.6g}" for v in truth.tolist()),
        "spce": float(spce),
        "snmc": float(snmc),
        "lower": lower,
        "upper": upper,
        "effective": effective,
        "cpu_bounds": time.process_time() - start,
        "places": " ".join(f"{v:.6g}" for v in action.flatten().tolist()),
    }
    row |= {f"cpu_{stage}": spent for stage, spent in seconds.items()}
    if isinstance(player, Myopic):
        gain = player.belief.log_prob(truth) - task.prior.log_prob(truth)
        row |= {
            "belief_gain": float(gain),
            "num_simulations": player.num_simulations,
        }
    return row


main = benchmark(
    Path(__file__).with_name("rows.csv"),
    roll_out,
    table,
    policy=POLICIES,
    rollout=range(64),
    trials=(30,),
)
