"""CPU time of a round of the default loop beside stock sbi on the same rows.

    python -m benchmarks cost

Both run in this process on one thread: NPE_C(prior) with sbi's defaults, trained on
5,000 rows of the numerical task with x and the action as its condition; and one round
of a campaign with the defaults of this library on 5,000 rows, simulation, training,
design and update together. sbi runs first and so pays what torch does once a process
(about one second); three rounds of ours follow.
"""

from __future__ import annotations

import time
from pathlib import Path

import torch
from sbi.inference import NPE_C

from benchmarks.rows import recorded
from sbi_active import Campaign
from sbi_active.inference.trainers.action_rounds import SilentTracker
from sbi_active.seeding import derive_seed
from sbi_active.simulation import simulate
from sbi_active.tasks import get_task  # pyright: ignore

NUM_ROWS = 5_000


def stock_round(seed: int) -> dict[str, float]:
    """Return the CPU time of sbi's training, and its epochs."""
    task = get_task("numerical")
    torch.manual_seed(seed)
    theta = task.prior.sample((NUM_ROWS,))
    action = task.actions.sample((NUM_ROWS,))
    x = simulate(task.simulator, theta, action, seed=seed).x
    trainer = NPE_C(task.prior, tracker=SilentTracker(), show_progress_bars=False)
    start = time.process_time()
    trainer.append_simulations(theta, torch.cat([x, action], 1)).train()
    seconds = time.process_time() - start
    return {"cpu_s": seconds, "epochs": trainer.summary["epochs_trained"][-1]}


def default_round(seed: int) -> dict[str, float]:
    """Return the CPU time of one round of a campaign, by stage."""
    task = get_task("numerical")
    campaign = Campaign(task.simulator, task.prior, task.actions, seed=seed)
    start = time.process_time()
    trial = campaign.ask()
    campaign.tell(task.real_system(trial.action, seed=derive_seed(seed, "real")))
    campaign.update()
    seconds = time.process_time() - start
    return {"cpu_s": seconds, **campaign.history[0].cpu_seconds}


def main() -> None:
    stock = stock_round(0)
    default = [default_round(seed) for seed in range(3)]
    theirs = stock["cpu_s"]
    ours = sum(r["cpu_s"] for r in default) / len(default)
    made = {"rows": NUM_ROWS, "default_round": default, "stock_npe_c": stock}
    path = Path(__file__).parent / "result.json"
    recorded(path, "cost", **made, ratio=theirs / ours)
    print(f"stock NPE_C(prior), training:    {theirs:7.2f} CPU s")
    print(f"default loop, a whole round:     {ours:7.2f} CPU s")
    print(f"ratio:                           {theirs / ours:7.1f}")
