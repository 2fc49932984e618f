"""The next two trials together, where the cost of one depends on the one before."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from sbi_active.design.design import Design
from sbi_active.design.limits import DesignLimits


def first_of_pair(
    design: Design,
    limits: DesignLimits,
    beyond: Callable[[Tensor, Tensor], Design],
    *,
    num: int = 8,
) -> Design:
    r"""Return the design of the first action of the pair that tells most by its cost.

    .. math::
        \arg\max_{\xi_1} \max_{\xi_2}
        \frac{I(\theta; x_1, x_2)}{c(\xi_1) + c(\xi_2 | \xi_1)}

    over the best actions by their own gain and cost, each followed by the best ones
    from there. An action that nothing affordable can follow counts alone.

    Args:
        design: Design of the next action alone.
        limits: Limits of the next action, with its cost and what is left to spend.
        beyond: Function of a first action (action_dim,) and places (k, action_dim) that
            gives the design of the second, by what it tells beyond the first.
        num: Number of first actions, and of second ones after each.
    """
    candidates, cost = design.candidates, limits.cost(design.candidates)
    gain = design.expected_information_gain.nan_to_num(0.0)
    alone, steps = gain / cost, [design]
    plans: list[tuple[float, float, list[int]]] = []  # nats, cost, order
    for k in _largest(alone, num):
        after = replace(
            limits, previous=candidates[k], left=limits.left - float(cost[k])
        )
        near = torch.nonzero(after(candidates))[:, 0]
        told, paid, orders = gain[[k]], cost[[k]], [[k]]
        if len(near):
            then = after.cost(candidates[near])
            best = _largest(gain[near] / then, num)
            steps.append(beyond(candidates[k], candidates[near[best]]))
            told = told + steps[-1].expected_information_gain.nan_to_num(0.0)
            orders, paid = [[k, j] for j in near[best].tolist()], paid + then[best]
        plans += zip(told.tolist(), paid.tolist(), orders, strict=True)
    told, paid, pair = max(plans, key=lambda plan: plan[0] / plan[1])
    # Either order tells the same: what tells more by itself is not put off for ever.
    alike = [p for p in plans if sorted(p[2]) == sorted(pair) and p[1] <= paid + 1e-9]
    order = max((plan[2] for plan in alike), key=lambda order: float(alone[order[0]]))
    places = [", ".join(f"{v:.4g}" for v in candidates[k].tolist()) for k in order]
    note = f"planned [{'], then ['.join(places)}]: {told:.3g} nats for {paid:.4g}"
    error = design.difference_standard_error
    if order[0] != design.index:  # errors of differences were to another action
        error = torch.full_like(error, math.nan)
    return replace(
        design,
        action=candidates[order[0]],
        index=order[0],
        difference_standard_error=error,
        num_simulations=sum(step.num_simulations for step in steps),
        num_missing=sum(step.num_missing for step in steps),
        notes=(*design.notes, note),
    )


def _largest(values: Tensor, num: int) -> list[int]:
    """Return the places of the largest values, in order."""
    return values.topk(min(num, len(values))).indices.tolist()
