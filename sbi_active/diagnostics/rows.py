"""Rows of a check: groups of actions, and draws of a network within the support."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from sklearn.cluster import KMeans
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.seeding import derive_seed
from sbi_active.support import within_support


def stratified_actions(
    space: ActionSpace, num_rows: int, max_strata: int, seed: int
) -> tuple[Tensor, Tensor, list[str]]:
    """Return actions, the group of each, and what the groups are called.

    Up to ``max_strata`` listed actions are a group each, with as many rows; of more
    actions, or of a continuum, neighbors are put together.

    Args:
        space: Space of the actions.
        num_rows: Rows n.
        max_strata: Groups at most.
        seed: Seed of draws and groups.

    Returns:
        Actions (n, action_dim), labels (n,) int64, and a name a group.
    """
    listed = space.listed()
    if listed is not None and len(listed) <= max_strata:
        label = torch.arange(num_rows) % len(listed)
        return listed[label], label, [_name(space, row) for row in listed]
    action = space.sample((num_rows,), seed=derive_seed(seed, "action"))
    scale = action.double().std(0).clamp_min(1e-12)
    places = (action.double() / scale).numpy()
    groups = min(max_strata, len(np.unique(places, axis=0)))
    means = KMeans(groups, n_init=4, random_state=derive_seed(seed, "k") % 2**31)  # pyright: ignore
    label = torch.from_numpy(means.fit_predict(places).astype(np.int64))
    names = [f"near {_name(space, action[label == k].mean(0))}" for k in range(groups)]
    return action, label, names


def _name(space: ActionSpace, action: Tensor) -> str:
    cells = zip(space.names, action.tolist(), space.units, strict=True)
    return ", ".join(f"{n} {v:.3g}{' ' + u if u else ''}" for n, v, u in cells)


def draws_within(
    network: Any, prior: Distribution, num: int, condition: Tensor, *, times: int = 10
) -> Tensor:
    """Return draws of a network within the prior's support, shape (num, n, theta_dim).

    Rejection waits without end for a row whose network lies beside the support, which
    is what a check meets. Such a row keeps its draws outside, where they are wrong.

    Args:
        network: Estimator over packed conditions.
        prior: Prior with the support.
        num: Number of draws of each row.
        condition: Packed conditions, shape (n, c).
        times: Times as many draws as are needed, of which those inside are taken.
    """
    drawn = network.sample(torch.Size([times * num]), condition)
    inside = within_support(prior, drawn.flatten(0, 1)).reshape(drawn.shape[:2])
    first = (~inside).to(torch.int8).argsort(dim=0, stable=True)[:num]
    return drawn.gather(0, first[..., None].expand(-1, -1, drawn.shape[-1]))
