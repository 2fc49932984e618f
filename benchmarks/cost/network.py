"""CPU time of a round that trains its network each time, and of one on demand.

    python -m benchmarks cost.network

Campaigns of the numerical task, whose noise is declared, with the defaults and with
``CampaignOptions(network="on demand")``; the two take turns, seed by seed, in one
process on one thread. The first campaign pays what torch does once a process, so that
one of each runs before the clock. Writes network.json beside this file: CPU seconds a
round by stage, simulations a round, and what the campaigns ended with.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.rounds import played
from benchmarks.rows import recorded
from sbi_active import CampaignOptions
from sbi_active.seeding import forked_generators
from sbi_active.tasks import get_task  # pyright: ignore

MODES = ("each round", "on demand")
SEEDS, ROUNDS = 8, 3


def rounds(
    mode: Any, seed: int, num_rounds: int
) -> tuple[list[dict[str, Any]], list[float]]:
    """Return what each round cost, and the standard deviations after the last."""
    task, rows = get_task("numerical"), []
    options = CampaignOptions(network=mode)
    for campaign, spent in played(task, seed, num_rounds, options=options):
        trial = campaign.history[-1]
        own = {"cpu_s": spent, "num_simulations": trial.num_simulations}
        rows.append(own | trial.cpu_seconds)
    with forked_generators(0):
        return rows, campaign.belief.sample((4_000,)).std(0).tolist()


def main() -> None:
    """Run both modes in turn, print and write their cost."""
    made: dict[str, list[Any]] = {mode: [] for mode in MODES}
    for mode in MODES:
        rounds(mode, 10_000, 1)
    for seed in range(SEEDS):
        for mode in MODES:
            made[mode].append(rounds(mode, seed, ROUNDS))
    result: dict[str, Any] = {"machine": f"{os.cpu_count()} cores, no GPU"}
    result["task"] = "numerical, declared noise"
    for mode, campaigns in made.items():
        rows = [row for campaign, _ in campaigns for row in campaign]
        each = np.array([row["cpu_s"] for row in rows])
        names = sorted({name for row in rows for name in row} - {"cpu_s"})
        result[mode] = {
            "cpu_s_a_round": each.mean(),
            "standard_error": each.std(ddof=1) / len(each) ** 0.5,
            **{n: float(np.mean([r.get(n, 0.0) for r in rows])) for n in names},
            "median_sd": np.median([sd for _, sd in campaigns], axis=0).tolist(),
        }
    both = [result[mode]["cpu_s_a_round"] for mode in MODES]
    result["ratio"] = both[0] / both[1]
    recorded(Path(__file__).with_name("network.json"), "cost.network", **result)
    for mode in MODES:
        print(f"{mode}: {json.dumps(result[mode])}")
    print(f"ratio: {result['ratio']:.1f}")
