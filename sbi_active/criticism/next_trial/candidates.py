"""Actions at which rivals are compared, permitted ones and such as lie beyond."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sbi_active.actions import ActionSpace
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.rivals.further_trials import are_known, unmeasured
from sbi_active.criticism.steps.predictive import predict
from sbi_active.seeding import derive_seed


@dataclass(frozen=True, kw_only=True)
class PlanSettings:
    """Settings of the search for the next action.

    Attributes:
        max_candidates: Permitted actions at most, each predicted by every rival.
        max_outside: Actions beyond the permitted range at most.
        wider: Factors by which that range is widened about its center.
        negligible: Probability below which a rival is left out.
        max_rivals: Rivals at most.
        fewest: Probability that a model in question has at least.
        nothing: Information below which no action is worth a trial, nats.
        something: Information of another action that is worth a second choice, nats.
        samples: Outcomes of a candidate and rival, half to choose and half to report.
            Of a half, three quarters fit a density, which needs some tens.
        max_tests: Candidates of a severe test, and as many beyond the range.
        num_draws: Draws of each prediction in a severe test.
        max_entries: Covariances of the residual process in a severe test.
    """

    max_candidates: int = 64
    max_outside: int = 24
    wider: tuple[float, float] = (1.5, 2.0)
    negligible: float = 0.01
    max_rivals: int = 8
    fewest: float = 1e-3
    nothing: float = 0.02
    something: float = 0.1
    samples: int = 160
    max_tests: int = 16
    num_draws: int = 50
    max_entries: int = 10_000_000


PLAN = PlanSettings()


def permitted_candidates(rivals: RivalSet, actions: ActionSpace) -> Tensor:
    """Return all permitted actions, or as many at random, shape (a, action_dim)."""
    listed = actions.listed()
    if listed is not None and len(listed) <= PLAN.max_candidates:
        return listed
    seed = derive_seed(rivals.seed, "candidates")
    return actions.sample((PLAN.max_candidates,), seed=seed)


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
    last = float(rivals.trials.index.max())
    index = torch.full((len(candidates),), last + 1)
    return unmeasured(rivals.model, rivals.trials, candidates, index)


def beyond_range(
    actions: ActionSpace, candidates: Tensor, *, limit: int, mirrored: bool = False
) -> Tensor:
    """Return actions beyond the range of the permitted ones, the nearest first.

    They are the permitted ones in a range widened about its center. Entries that have
    one sign keep it: a speed or a mass has no other.

    Args:
        actions: The permitted ones.
        candidates: Candidates, some or all actions, shape (a, action_dim).
        limit: Actions at most.
        mirrored: Whether the zero action and the mirror images of permitted actions, in
            each entry and in all, are among them, and any sign is.

    Returns:
        Shape (b, action_dim), b <= limit.

    Example:
        >>> from sbi_active import DiscreteActions
        >>> speeds = DiscreteActions([1.0, 2.0, 3.0])
        >>> beyond_range(speeds, speeds.values, limit=9)[:, 0].tolist()
        [0.5, 3.5, 0.0, 4.0]
        >>> beyond_range(speeds, speeds.values, limit=9, mirrored=True)[:, 0].tolist()
        [0.5, 3.5, 0.0, 4.0, -1.0, -2.0, -3.0]
    """
    dim = candidates.shape[1]
    low, high = candidates.min(0).values, candidates.max(0).values
    center, half = (low + high) / 2, (high - low).clamp_min(1e-12) / 2
    parts = [center + factor * (candidates - center) for factor in PLAN.wider]
    lowest = torch.where((low < 0) | mirrored, -torch.inf, 0.0)
    highest = torch.where((high > 0) | mirrored, torch.inf, 0.0)
    if mirrored:
        signs = torch.cat([1 - 2 * torch.eye(dim), -torch.ones(1, dim)])
        parts += [torch.zeros(1, dim), *(candidates * sign for sign in signs)]
    every = torch.cat(parts).unique(dim=0)
    distance = ((every - every.clamp(low, high)) / half).square().sum(-1)
    is_beyond = (distance > 1e-9) & ~actions.contains(every)
    is_beyond &= ((every >= lowest) & (every <= highest)).all(-1)
    every, distance = every[is_beyond], distance[is_beyond]
    order = torch.argsort(distance, stable=True)[: 4 * limit]
    # Spread over the distances rather than the nearest alone.
    return spread_out(every[order], limit)


def spread_out(candidates: Tensor, limit: int) -> Tensor:
    """Return at most so many, evenly in their order, with the first and the last."""
    if len(candidates) <= limit:
        return candidates
    return candidates[torch.linspace(0, len(candidates) - 1, limit).round().long()]
