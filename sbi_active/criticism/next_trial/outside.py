"""Actions beyond the permitted ones that may separate what these do not."""

from __future__ import annotations

import torch
from torch import Tensor

from sbi_active.actions import ActionSpace

#: Factors by which the range of the actions is widened about its center.
WIDER = (1.5, 2.0)


def outside_candidates(
    actions: ActionSpace, candidates: Tensor, *, limit: int
) -> Tensor:
    r"""Return actions that are not permitted, nearest to the permitted ones first.

    They are the zero action, the mirror images of permitted actions in each entry and
    in all, and the permitted ones in a range widened about its center, as far as they
    lie beyond the range of the permitted ones.

    Args:
        actions: The permitted ones.
        candidates: Candidates, some or all actions, shape (a, action_dim).
        limit: Actions at most.

    Returns:
        Shape (b, action_dim), b <= limit.

    Example:
        >>> from sbi_active import DiscreteActions
        >>> speeds = DiscreteActions([1.0, 2.0, 3.0])
        >>> outside_candidates(speeds, speeds.values, limit=9)[:, 0].tolist()
        [0.5, 3.5, 0.0, 4.0, -1.0, -2.0, -3.0]
    """
    dim = candidates.shape[1]
    signs = 1 - 2 * torch.eye(dim)
    if dim > 1:
        signs = torch.cat([signs, -torch.ones(1, dim)])
    parts = [torch.zeros(1, dim)]
    parts += [candidates * sign for sign in signs]
    return _nearest(actions, candidates, [*parts, *_widened(candidates)], limit)


def extrapolated(actions: ActionSpace, candidates: Tensor, *, limit: int) -> Tensor:
    """Return the permitted actions in a range widened about its center, as far beyond.

    Entries that have one sign keep it: a speed or a mass has no other.

    Args:
        actions: The permitted ones.
        candidates: Candidates, some or all actions, shape (a, action_dim).
        limit: Actions at most.

    Returns:
        Shape (b, action_dim), b <= limit, the nearest first.

    Example:
        >>> from sbi_active import DiscreteActions
        >>> speeds = DiscreteActions([1.0, 2.0, 3.0])
        >>> extrapolated(speeds, speeds.values, limit=9)[:, 0].tolist()
        [0.5, 3.5, 0.0, 4.0]
    """
    low, high = candidates.min(0).values, candidates.max(0).values
    lowest = torch.where(low < 0, -torch.inf, 0.0)
    highest = torch.where(high > 0, torch.inf, 0.0)
    parts = [
        part[((part >= lowest) & (part <= highest)).all(-1)]
        for part in _widened(candidates)
    ]
    return _nearest(actions, candidates, parts, limit)


def _widened(candidates: Tensor) -> list[Tensor]:
    center = (candidates.min(0).values + candidates.max(0).values) / 2
    return [center + factor * (candidates - center) for factor in WIDER]


def _nearest(
    actions: ActionSpace, candidates: Tensor, parts: list[Tensor], limit: int
) -> Tensor:
    """Return those that lie beyond, at most so many, nearest first."""
    low, high = candidates.min(0).values, candidates.max(0).values
    half = (high - low).clamp_min(1e-12) / 2
    every = torch.cat(parts).unique(dim=0)
    distance = ((every - every.clamp(low, high)) / half).square().sum(-1)
    beyond = (distance > 1e-9) & ~actions.contains(every)
    every, distance = every[beyond], distance[beyond]
    order = torch.argsort(distance, stable=True)[: 4 * limit]
    if len(order) > limit:  # spread over the distances rather than the nearest alone
        order = order[torch.linspace(0, len(order) - 1, limit).round().long()]
    return every[order]
