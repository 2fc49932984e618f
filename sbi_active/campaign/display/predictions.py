"""Simulations from the belief before a trial, with which its outcome is compared."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.distributions import Distribution

from sbi_active.campaign.state import CampaignState
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import simulate

Array = NDArray[Any]


def predict(
    state: CampaignState,
    simulator: Callable[[int], Any] | None,
    prior: Distribution,
    num_simulations: int,
) -> dict[int, Array]:
    """Return simulations of each executed action, by the index of its trial, (n, q).

    They use the kept draws of the belief before the trial. Where these draws are of
    other parameters, those of an earlier model, there is no prediction.

    Args:
        state: State of the campaign.
        simulator: Simulator of a trial, by its index; None for no predictions.
        prior: Prior of the current parameters.
        num_simulations: Simulations of each trial; 0 for no predictions.
    """
    if simulator is None or num_simulations == 0:
        return {}
    with forked_generators(derive_seed(state.seed, "shown")):
        before = prior.sample(torch.Size([num_simulations]))
    before = before.reshape(num_simulations, -1)
    dim, found = before.shape[1], {}
    for index in state.processed:
        trial = state.trials[index]
        if trial.status == "ok" and trial.x is not None and before.shape[1] == dim:
            theta = before[torch.arange(num_simulations) % len(before)]
            rows = simulate(
                simulator(index),
                theta,
                trial.action.expand(num_simulations, -1),
                seed=derive_seed(state.seed, "shown", index),
                workers=state.options.workers,
            )
            x = rows.without_missing().x.flatten(1).double().numpy()
            if np.isfinite(x).any():
                found[index] = x
        before = state.draws.get(index, before)
    return found
