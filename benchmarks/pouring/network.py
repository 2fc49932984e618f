r"""ALHI and NLHI: one neural likelihood of a summary given theta and action.

The paper's likelihood-based methods (section 4.1), which know of the same bank: a
mixture density network of the paper's size and training learns
:math:`q(\phi_\delta(x) | \theta, \xi)` for each summary from all pours at once, beliefs
are the prior times the product over the trials, and ALHI chooses by

.. math::
    \log q(x | \theta, \xi) - \log \frac{1}{M} \sum_j q(x | \theta_j, \xi).

Two things differ from the paper: one training serves all rounds, as for our other
methods, and the belief is normalized on the grid, where it has kernels. The components
are those of all pours, since one network is shown all actions.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from attrs import evolve
from torch import Tensor

from benchmarks.pouring.bank import read_parts
from benchmarks.pouring.learned import (
    NUM_COMPONENTS,
    PARTS,
    Earlier,
    looked_at,
    summaries_of,
)
from benchmarks.pouring.likelihood import components
from sbi_active import ALHI
from sbi_active.inference.models.factors import ActionLikelihood
from sbi_active.inference.networks.mixture_density import MixtureDensity
from sbi_active.seeding import forked_generators
from sbi_active.tasks import get_task

HIDDEN, NUM_ITERATIONS, BATCH = (64, 64), 1_000, 30  # the paper's, section 5.4
NUM_OUTER, NUM_ALL = 40, 100  # draws behind a gain; the paper's M is 100
AT_ONCE = 2_000  # rows of a network's input


@dataclass(frozen=True)
class ByNetwork:
    """A neural likelihood for each summary.

    Attributes:
        networks: By delta.
        actions: Shape (27, 3).
        mean: Of thumbnails, shape (900,).
        axes: Of components, shape (900, k).
    """

    networks: list[ActionLikelihood]
    actions: Tensor
    mean: np.ndarray
    axes: np.ndarray

    def gains(self, belief: Any, earlier: Earlier, seed: int) -> np.ndarray:
        """Return gains by delta and action, nats, on common draws."""
        with forked_generators(seed):
            theta = belief.sample(torch.Size([NUM_ALL])).float()
            values = np.array(
                [
                    [self._gain(network, theta, action) for action in self.actions]
                    for network in self.networks
                ]
            )
        return values.mean(2)

    def _gain(
        self, network: ActionLikelihood, theta: Tensor, action: Tensor
    ) -> np.ndarray:
        outer = theta[:NUM_OUTER]
        with torch.no_grad():
            x = network.sample(outer, action.expand(NUM_OUTER, -1))
            table = network.log_likelihood_table(x, theta, action).double()
        own = table.diagonal()
        return (own - table.logsumexp(1) + np.log(NUM_ALL)).numpy()

    def log_likelihood(
        self, theta: np.ndarray, image: Tensor, delta: int, place: int, earlier: Earlier
    ) -> np.ndarray:
        """Return log densities of an image at theta (n, 3), shape (n,)."""
        mesh, small = looked_at(image[None])
        summary = np.sqrt(mesh) if delta else (small - self.mean) @ self.axes
        x = torch.from_numpy(summary).float()
        rows = torch.from_numpy(theta).float().split(AT_ONCE)
        with torch.no_grad():
            table = [
                self.networks[delta].log_likelihood_table(x, part, self.actions[place])
                for part in rows
            ]
        return torch.cat(table, 1)[0].double().numpy()


def learn_networks(folder: Path) -> ByNetwork:
    """Return the networks, trained on a bank."""
    task: Any = get_task("pouring")
    rows = read_parts(folder, PARTS)
    mesh, small = summaries_of(rows, task)
    mean, axes = components(small, NUM_COMPONENTS)
    faithful = MixtureDensity.faithful()
    settings = evolve(
        faithful,
        hidden_features=HIDDEN,
        num_iterations=NUM_ITERATIONS,
        details=evolve(faithful.details, batch_size=BATCH),
    )
    networks = []
    for summary in ((small - mean) @ axes, np.sqrt(mesh)):
        x = torch.from_numpy(summary).float()
        with forked_generators(0, "neural likelihood"):
            inference = ALHI(task.prior, settings, show_progress_bars=False)
            inference.append_simulations(rows.theta, x, action=rows.action).train()
            networks.append(inference.build_posterior())
    return ByNetwork(networks, task.actions.values, mean, axes)
