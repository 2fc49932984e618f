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
    best, plan, joint = -math.inf, [design.index], 0.0
    steps = [design]
    for k in _largest(gain / cost, num):
        after = limits.after(candidates[k], limits.left - float(cost[k]))
        near = torch.nonzero(after(candidates))[:, 0]
        pairs, told, paid = [[k]], gain[k : k + 1], cost[k : k + 1]
        if len(near):
            then = after.cost(candidates[near])
            order = _largest(gain[near] / then, num)
            steps.append(beyond(candidates[k], candidates[near[order]]))
            told = told + steps[-1].expected_information_gain.nan_to_num(0.0)
            pairs, paid = [[k, int(near[j])] for j in order], paid + then[order]
        j = int((told / paid).argmax())
        if float(told[j] / paid[j]) > best:
            best, plan, joint = float(told[j] / paid[j]), pairs[j], float(told[j])

    def dearness(order: list[int]) -> tuple[float, float]:
        total = float(cost[order[0]])
        if order[1:]:
            total += float(
                limits.after(candidates[order[0]]).cost(candidates[order[1:]])
            )
        return total, -float(gain[order[0]] / cost[order[0]])

    # Either order tells the same; else what tells least may be done first, for ever.
    plan = min(plan, plan[::-1], key=dearness)
    places = "; then ".join(str(candidates[[k]].tolist()[0]) for k in plan)
    note = f"planned {places}: {joint:.3g} nats for a cost of {dearness(plan)[0]:.4g}"
    error = design.difference_standard_error
    if plan[0] != design.index:  # errors of differences were to another action
        error = torch.full_like(error, math.nan)
    return replace(
        design,
        action=candidates[plan[0]],
        index=plan[0],
        difference_standard_error=error,
        num_simulations=sum(step.num_simulations for step in steps),
        num_missing=sum(step.num_missing for step in steps),
        notes=(*design.notes, note),
    )


def _largest(values: Tensor, num: int) -> list[int]:
    """Return the places of the largest values, in order."""
    return values.topk(min(num, len(values))).indices.tolist()
