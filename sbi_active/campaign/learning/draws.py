"""Draws of the beliefs along the way, for pictures of what was known when."""

from __future__ import annotations

import torch
from torch.distributions import Distribution

from sbi_active.campaign.state import CampaignState
from sbi_active.seeding import derive_seed, forked_generators

NUM_KEPT = 256  # 4 % error of a standard deviation, and 3 kB a trial of 3 parameters


def keep_draws(state: CampaignState, belief: Distribution) -> None:
    """Keep draws of the belief after the last trial that it contains.

    Nothing is computed from them, and no other random number depends on them.

    Args:
        state: State of the campaign.
        belief: Belief after ``state.processed``.
    """
    if not state.processed:
        return
    index = state.processed[-1]
    seed = derive_seed(state.seed, "draws", index)
    quick = getattr(belief, "quick_sample", None)
    if quick is not None:
        draws = quick(NUM_KEPT, seed=seed)
    else:  # the prior, where nothing explained the trials
        with forked_generators(seed):
            draws = belief.sample(torch.Size([NUM_KEPT]))
    state.draws[index] = draws.reshape(NUM_KEPT, -1).detach()
