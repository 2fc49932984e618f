r"""The static design of T places that tells most, by stochastic gradient ascent.

    python -m benchmarks location_finding.static_design

All places are chosen before the first measurement. Ascends the prior contrastive bound

.. math::
    E \left[ \log p(h_i | \theta_i) - \log \frac1m \sum_j p(h_i | \theta_j) \right]
    \le \min(I, \log m)

in the places, with fresh parameters and noise in each step; the m parameters of a batch
are contrasted with all its histories. Writes static_design.csv beside this file.

References:
    Foster et al., AISTATS 2020, arXiv:1911.00294 (gradients of contrastive bounds);
    Foster et al., ICML 2021, arXiv:2103.02438 (the "fixed" baseline).
"""

from __future__ import annotations

import csv
import math
import time
from pathlib import Path

import torch
from torch import Tensor

from sbi_active.tasks.location_finding.model import NOISE_SD, mean

PATH = Path(__file__).parent / "static_design.csv"


def contrastive_bound(
    place: Tensor, theta: Tensor, noise: Tensor, num_histories: int
) -> Tensor:
    r"""Return the bound from one batch; differentiable in the places.

    Args:
        place: Shape (T, 2).
        theta: :math:`\theta_j`, shape (m, 2 K).
        noise: Of the histories, standard normal, shape (num_histories, T).
        num_histories: Histories, of the first parameters.
    """
    center = mean(theta[:, None], place)[..., 0] / NOISE_SD  # (m, T)
    x = center[:num_histories] + noise
    square = x.square().sum(1, keepdim=True) - 2 * x @ center.T + center.square().sum(1)
    own = noise.square().sum(1)
    return (-0.5 * own - (-0.5 * square).logsumexp(1)).mean() + math.log(len(theta))


def optimize(
    num_trials: int,
    *,
    num_steps: int = 600,
    num_histories: int = 512,
    num_contrastive: int = 2_048,
    learning_rate: float = 0.05,
    seed: int = 0,
) -> Tensor:
    """Return places, shape (T, 2), by Adam from standard normal ones.

    Args:
        num_trials: T.
        num_steps: Of the optimizer; its rate falls to zero along a cosine.
        num_histories: In a batch.
        num_contrastive: Parameters m in a batch.
        learning_rate: At the start.
        seed: Of everything drawn.
    """
    generator = torch.Generator().manual_seed(seed)
    place = torch.randn(num_trials, 2, generator=generator).requires_grad_()
    optimizer = torch.optim.Adam([place], lr=learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, num_steps)
    for step in range(num_steps):
        theta = torch.randn(num_contrastive, 4, generator=generator)
        noise = torch.randn(num_histories, num_trials, generator=generator)
        loss = -contrastive_bound(place, theta, noise, num_histories)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % 200 == 0:
            print(f"step {step}: {-loss.item():.3f} nats")
    return place.detach()


def load() -> Tensor:
    """Return the committed places, shape (T, 2)."""
    with PATH.open(newline="") as file:
        rows = [
            [float(row["place_x"]), float(row["place_y"])]
            for row in csv.DictReader(file)
        ]
    return torch.tensor(rows)


def main(
    *,
    trials: int = 30,
    steps: int = 600,
) -> None:
    """Run what is asked for and is not there yet, and print the table.

    Args:
        trials: Number of trials.
        steps: Steps of the search.
    """
    start = time.process_time()
    place = optimize(trials, num_steps=steps)
    with PATH.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["place_x", "place_y"])
        writer.writerows([f"{v:.5f}" for v in row] for row in place.tolist())
    print(f"{PATH.name}: {time.process_time() - start:.0f} CPU s")
