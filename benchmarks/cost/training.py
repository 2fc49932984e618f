"""How long the round's network is trained, and what it scores on rows it never saw.

    python -m benchmarks cost.training

The earlier settings beside the default ones, in turn, seed by seed, in one process on
one thread: CPU seconds of a whole round of a campaign and of its training,
and the mean of log q(theta | x, action) over fresh rows, nats, of a network that was
trained on 5,000 rows of the prior. Seeds below 100 served to set the defaults; these
are others, though the choice was revised once after ten components had lost on the
chain here. Writes training.json beside this file.
"""

from __future__ import annotations

import json
import os
import time
from datetime import date
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from sbi.utils import BoxUniform
from torch import Tensor

from benchmarks.rounds import played
from benchmarks.rows import keep
from sbi_active import (
    ASBI,
    BoxActions,
    CampaignOptions,
    MixtureDensity,
    simulate,
)
from sbi_active.inference.networks.mixture_density import MixtureDetails
from sbi_active.seeding import forked_generators
from sbi_active.tasks import get_task  # pyright: ignore

BEFORE = MixtureDensity(
    hidden_features=(128, 128),
    num_components=5,
    num_iterations=400,
    details=MixtureDetails(activation="relu", batch_size=100, learning_rate=5e-3),
)
WAYS = {"before": BEFORE, "now": MixtureDensity()}
NUM_ROWS, NUM_FRESH = 5_000, 10_000
SEEDS = range(100, 106)


def oscillation(theta: Tensor, action: Tensor) -> Tensor:
    """Position and velocity of a damped oscillator at 20 times, shape (n, 20, 2)."""
    time = torch.linspace(0.1, 3, 20)
    rate, decay = 1 + theta[:, :1], 0.2 + theta[:, 1:2] / 2
    size = (theta[:, 2:] + action[:, :1]) * torch.exp(-decay * time)
    phase = rate * time
    x = [size * torch.cos(phase * action[:, 1:]), -size * rate * torch.sin(phase)]
    both = torch.stack(x, -1)
    return both + 0.05 * torch.randn_like(both)


def problems() -> dict[str, Any]:
    """Return the numerical task, 20 x 2 numbers, and eight parameters of a chain."""
    found: dict[str, Any] = {name: get_task(name) for name in ("numerical", "chain")}
    truth = torch.tensor([[0.4, 0.6, 0.5]])

    def real(action: Tensor, *, seed: int) -> Tensor:
        with forked_generators(seed):
            return oscillation(truth, action[None])[0]

    found["20 x 2 numbers"] = SimpleNamespace(
        simulator=oscillation,
        prior=BoxUniform(torch.zeros(3), torch.ones(3)),
        actions=BoxActions([0.5, 0.5], [1.5, 1.5]),
        real_system=real,
    )
    return found


def score(own: Any, settings: MixtureDensity, seed: int) -> tuple[float, float]:
    """Return the mean log density of fresh rows and the CPU seconds of training."""
    with forked_generators(seed):
        theta = own.prior.sample((NUM_ROWS + NUM_FRESH,))
        action = own.actions.sample((len(theta),))
    x = simulate(own.simulator, theta, action, seed=seed).x
    fit, fresh = slice(0, NUM_ROWS), slice(NUM_ROWS, None)
    torch.manual_seed(seed)
    inference = ASBI(own.prior, settings, show_progress_bars=False)
    inference.append_simulations(theta[fit], x[fit], action=action[fit])
    start = time.process_time()
    network = inference.train()
    spent = time.process_time() - start
    condition = torch.cat([x[fresh].flatten(1), action[fresh]], 1)
    with torch.no_grad():
        return -float(network.loss(theta[fresh], condition).mean()), spent


def cost(own: Any, settings: MixtureDensity, seed: int) -> dict[str, float]:
    """Return CPU seconds of the second round of a campaign, by stage."""
    options = CampaignOptions(density_estimator=settings)
    _, (campaign, spent) = played(own, seed, 2, options=options)
    return {"round": spent, **campaign.history[-1].cpu_seconds}


def main() -> None:
    """Run both settings in turn, print and write."""
    result: dict[str, Any] = {
        "command": "python -m benchmarks cost.training",
        "date": date.today().isoformat(),
        "machine": f"{os.cpu_count()} cores, no GPU",
    }
    for name, own in problems().items():
        made: dict[str, list[Any]] = {way: [] for way in WAYS}
        costs: dict[str, list[Any]] = {way: [] for way in WAYS}
        cost(own, MixtureDensity(), 1_000)  # what torch does once a process
        for seed in SEEDS:
            for way, settings in WAYS.items():
                made[way].append(score(own, settings, seed))
                costs[way].append(cost(own, settings, seed))
        gap = np.array(made["now"])[:, 0] - np.array(made["before"])[:, 0]
        for way in WAYS:
            both = np.array(made[way])
            row = result[f"{name}, {way}"] = {
                "log_score": both[:, 0].mean(),
                "standard_error": both[:, 0].std(ddof=1) / len(both) ** 0.5,
                "training_cpu_s": both[:, 1].mean(),
            }
            for key in ("round", "training"):
                each = [row[key] for row in costs[way]]
                row[f"{key}_of_campaign_cpu_s"] = float(np.median(each))
            if way == "now":
                row["gain"] = gap.mean()
                row["gain_error"] = gap.std(ddof=1) / len(gap) ** 0.5
            print(f"{name}, {way}: {json.dumps(row)}", flush=True)
    path = Path(__file__).with_suffix(".json")
    keep(path, result)
