"""What is told of a trial, checked before it is recorded."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.campaign.state import CampaignState, Status, Trial
from sbi_active.inference.condition import outcome_rows

__all__ = ["outcome_told", "same_outcome", "trial_to_tell"]


def trial_to_tell(
    state: CampaignState, trial: Trial | int | None, *, has_action: bool
) -> Trial:
    """Return the trial that is meant, a new one where none is pending.

    Args:
        state: Of the campaign.
        trial: The trial, its index, or None for the pending one.
        has_action: Whether an executed action was told.

    Raises:
        ValueError: If there is no such trial.
    """
    if trial is None:
        pending = [t for t in state.trials if t.status == "pending"]
        if pending:
            return pending[0]
        if not has_action:
            raise ValueError(
                "expected a pending trial; got none; do ask() first, or pass "
                "action= to record a trial that was not asked for"
            )
        return Trial(len(state.trials), torch.empty(0))
    index = trial.index if isinstance(trial, Trial) else trial
    if not 0 <= index < len(state.trials):
        raise ValueError(
            f"expected the index of one of {len(state.trials)} trials; got "
            f"{index}; do pass the trial that ask() returned"
        )
    return state.trials[index]


def outcome_told(x: Any, status: Status, x_shape: torch.Size) -> Tensor | None:
    """Return the outcome, NaN where not measured, shape x_shape.

    None for a missing trial. A number that is infinite was not measured either.

    Raises:
        ValueError: If there is no outcome, or one of another shape.
    """
    if status == "missing":
        return None
    if status == "invalid":  # numbers told along with it are no measurement
        return torch.full(x_shape, torch.nan)
    if x is None:
        raise ValueError(
            "expected the outcome x; got None; do tell(x), or tell(status=...) "
            "with 'invalid' or 'missing' where there is none"
        )
    tensor = x if isinstance(x, Tensor) else torch.as_tensor(np.asarray(x))
    if tensor.shape != x_shape and tensor.numel() == x_shape.numel() == 1:
        tensor = tensor.reshape(x_shape)
    return _measured(outcome_rows(tensor, x_shape)[0])


def _measured(x: Tensor) -> Tensor:
    """Return x with NaN for infinite numbers, which no sensor measures."""
    infinite = x.isinf()
    if not bool(infinite.any()):
        return x
    warnings.warn(
        f"{int(infinite.sum())} of {x.numel()} told numbers are infinite and count as "
        "not measured; pass NaN where a sensor gave nothing",
        stacklevel=4,
    )
    return torch.where(infinite, torch.nan, x)


def same_outcome(a: Trial, b: Trial) -> bool:
    """Return whether two records of a trial agree."""
    if a.status != b.status or not torch.equal(a.action, b.action):
        return False
    if a.x is None or b.x is None:
        return a.x is b.x
    return bool(torch.allclose(a.x, b.x, equal_nan=True))
