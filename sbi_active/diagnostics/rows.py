"""Rows of a check: groups of actions, and a posterior given the number of a row."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import torch
from sbi.inference.posteriors.direct_posterior import DirectPosterior
from sklearn.cluster import KMeans
from torch import Tensor

from sbi_active.actions import ActionSpace
from sbi_active.seeding import derive_seed
from sbi_active.support import within_support


def stratified_actions(
    space: ActionSpace, num_rows: int, max_strata: int, *, seed: int
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
    if listed is not None:  # each of them as often
        order = np.random.default_rng(derive_seed(seed, "order"))
        rounds = math.ceil(num_rows / len(listed))
        rows = np.concatenate([order.permutation(len(listed)) for _ in range(rounds)])
        action = listed[torch.from_numpy(rows[:num_rows])]
    scale = action.double().std(0).clamp_min(1e-12)
    places = (action.double() / scale).numpy()
    groups = min(max_strata, len(np.unique(places, axis=0)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        starts: Any = 4
        means = KMeans(
            groups, n_init=starts, random_state=derive_seed(seed, "k") % 2**31
        )
        label = torch.from_numpy(means.fit_predict(places).astype(np.int64))
    names = [f"near {_name(space, action[label == k].mean(0))}" for k in range(groups)]
    return action, label, names


def _name(space: ActionSpace, action: Tensor) -> str:
    cells = zip(space.names, action.tolist(), space.units, strict=True)
    return ", ".join(f"{n} {v:.3g}{' ' + u if u else ''}" for n, v, u in cells)


class RowPosterior(DirectPosterior):
    """Draws within the prior's support, at a bounded cost.

    Rejection waits without end for a row whose network lies beside the support, which
    is what a check meets. Such a row keeps its draws outside, where they are wrong.
    """

    @torch.no_grad()
    def sample_batched(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
        sample_shape: Any,
        x: Tensor,
        *,
        tries: tuple[int, ...] = (1, 8, 40),
        **_: Any,
    ) -> Tensor:
        """Return draws given each row, shape (m, n, theta_dim).

        Args:
            sample_shape: Shape of the draws, m in all.
            x: Numbers of the rows, shape (n, 1).
            tries: Times as many draws as are needed, for the rows that still lack.
        """
        num = torch.Size(sample_shape).numel()
        network: Any = self.posterior_estimator
        kept: Tensor = torch.empty(0)
        left = torch.arange(len(x))
        for times in tries:
            drawn = network.sample(torch.Size([times * num]), x[left])
            inside = within_support(self.prior, drawn.flatten(0, 1))
            inside = inside.reshape(drawn.shape[:2])
            first = (~inside).to(torch.int8).argsort(dim=0, stable=True)[:num]
            best = drawn.gather(0, first[..., None].expand(-1, -1, drawn.shape[-1]))
            kept = best.clone() if times == tries[0] else kept
            kept[:, left] = best
            left = left[inside.sum(0) < num]
            if len(left) == 0:
                break
        return kept
