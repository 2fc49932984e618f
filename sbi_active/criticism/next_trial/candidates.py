"""Actions at which rivals are compared, each as if it were the next trial."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from sbi_active.actions import ActionSpace
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.rivals.further_trials import are_known, conditions_at
from sbi_active.criticism.steps.predictive import predict
from sbi_active.seeding import derive_seed

#: A choice: each costs predictions of every rival.
MAX_CANDIDATES = 64


def permitted_candidates(rivals: RivalSet, actions: ActionSpace) -> Tensor:
    """Return all permitted actions, or as many at random, shape (a, action_dim)."""
    listed = actions.listed()
    if listed is not None and len(listed) <= MAX_CANDIDATES:
        return listed
    seed = derive_seed(rivals.seed, "candidates")
    return actions.sample((MAX_CANDIDATES,), seed=seed)


def simulated(rivals: RivalSet, candidates: Tensor) -> Tensor:
    """Return the candidates at which the bare model gives numbers.

    Beyond the permitted range a simulator may fail in any way. There is nothing beyond
    labels of trials.
    """
    kept = []
    if rivals.trials.action_is_label:
        return candidates[:0]
    candidates = candidates[are_known(rivals.model, rivals.trials, candidates)]
    with torch.no_grad():
        for action in candidates:
            try:
                prediction = predict(
                    rivals,
                    following(rivals, action[None]),
                    num_draws=4,
                    scored=False,
                )
            except Exception:  # noqa: BLE001  (a user's simulator)
                continue
            if np.isfinite(prediction.x).all() and prediction.valid.all():
                kept.append(action)
    return torch.stack(kept) if kept else candidates[:0]


def following(rivals: RivalSet, candidates: Tensor) -> Trials:
    """Return each candidate as if it were the next trial."""
    own, num = rivals.trials, len(candidates)
    x, times = own.template()
    trials = Trials(
        candidates.double(),
        x.expand(num, *x.shape),
        index=torch.full((num,), float(own.index.max()) + 1),
        sample_times=times,
        repeat_of=torch.full((num,), -1),
        **conditions_at(rivals.model, own, candidates),
    )
    trials.action_is_label = own.action_is_label
    return trials
