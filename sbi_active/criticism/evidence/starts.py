"""Starts of the search for a rival's posterior: posteriors of smaller rivals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.evidence.fit import Fit
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.rival import Rival

Array = NDArray[Any]

#: Searches that start at posteriors of smaller rivals.
NUM_NEAR = 8


def starts_near_parents(
    fits: Mapping[ModelKey, Fit], rival: Rival, seed: int
) -> Array | None:
    """Return points at posteriors of smaller rivals, the rest from the prior.

    The parents have one effect less; without effects, or behind a catch-all,
    it is the bare model.

    Args:
        fits: Rivals whose posterior is known.
        rival: Rival whose search starts.
        seed: Seed of the draws.

    Returns:
        Shape (k, dim); None without a parent.
    """
    parents = ModelKey(rival.key.effects).parts or [ModelKey()]
    known = [key for key in parents if key in fits]
    if not known or rival.key == ModelKey():
        return None
    rng = np.random.default_rng(seed)
    parts = []
    for key in known:
        parent = fits[key].rival
        each = max(NUM_NEAR // len(known), 1)
        drawn = parent.coordinates.to_z(fits[key].sample.draws(each, rng))
        z = rival.coordinates.to_z(rival.coordinates.sample(each, seed=seed))
        shared, theta_dim = parent.columns(), parent.theta_dim
        z[:, :theta_dim] = drawn[:, :theta_dim]
        for name, place in rival.columns().items():
            if name in shared:
                z[:, place] = drawn[:, shared[name]]
        parts.append(rival.coordinates.from_z(z))
    return np.concatenate(parts)
