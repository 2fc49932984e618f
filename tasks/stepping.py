"""Parts of simulators that step along an input held on a uniform grid."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["between", "is_on", "lagged", "row"]


def row(value: Tensor | float, num: int) -> Tensor:
    """Return a number, or one a row, as shape (num,), float64."""
    return torch.as_tensor(value, dtype=torch.float64).reshape(-1).expand(num)


def is_on(value: Tensor) -> bool:
    """Return whether an effect has any strength."""
    return bool((value != 0).any())


def lagged(drive: Tensor, steps: Tensor) -> Tensor:
    """Return the mean over each step of a drive behind a lag of first order.

    Exact for a drive that is held over each step, so that a lag far below a step still
    has a derivative. Before the first step the drive was what it is there.

    Args:
        drive: Steps first, shape (m, n).
        steps: Time constant in steps, shape (n,).
    """
    tau = steps.clamp(min=1e-9)
    left = torch.exp(-1 / tau)
    state, found = drive[0], []
    for now in drive:
        gap = state - now
        found.append(now + gap * tau * (1 - left))
        state = now + gap * left
    return torch.stack(found)


def between(path: Tensor, place: Tensor) -> Tensor:
    """Return a path at places in steps, linear between them.

    Args:
        path: Shape (n, m + 1).
        place: Shape (n, k); beyond the ends there are the ends.
    """
    place = place.clamp(0, path.shape[1] - 1)
    low = place.floor().long().clamp(max=path.shape[1] - 2)
    share = place - low
    return (1 - share) * path.gather(1, low) + share * path.gather(1, low + 1)
