"""The choice of a design from estimates of the candidates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from sbi_active.actions import ActionSpace
from sbi_active.design.design import Design, naming
from sbi_active.design.eligibility import DesignLimits
from sbi_active.design.elimination import Estimates
from sbi_active.information_gain.base import Bound
from sbi_active.information_gain.race import Race, paired_errors, standard_error


def choose(
    estimates: Estimates,
    limits: DesignLimits,
    *,
    estimator: str,
    bound: Bound,
    num_simulations: int,
    num_missing: int,
    seed: int,
) -> Design:
    """Return the design of the leader; the seed is that behind probabilities."""
    price = limits.cost(estimates.action)
    chosen = estimates.leader
    eligible = estimates.eligible
    report = estimates.reporting
    both = zip(estimates.choosing, report, eligible, price, strict=True)
    probability_best = torch.zeros(len(price), dtype=torch.float64)
    probability_best[eligible] = Race.run(
        [torch.cat([a, b]) / c for a, b, e, c in both if e], seed
    ).probability_best
    return Design(
        action=estimates.action[chosen],
        candidates=estimates.action,
        expected_information_gain=torch.stack([row.nanmean() for row in report]),
        standard_error=torch.stack([standard_error(row) for row in report]),
        difference_standard_error=paired_errors(report, chosen),
        probability_best=probability_best,
        probability_valid=estimates.probability_valid,
        bound=bound,
        index=chosen,
        num_simulations=num_simulations,
        estimator=estimator,
        num_samples=estimates.num_samples,
        stopped=estimates.stopped,
        num_missing=num_missing,
        notes=estimates.notes,
        cost=None if limits.price is None else price,
        **naming(limits.actions),
    )


def as_batch(steps: list[Design]) -> Design:
    """Return the design of several actions, or the only step itself."""
    if len(steps) == 1:
        return steps[0]
    return replace(
        steps[-1],
        action=torch.stack([step.action for step in steps]),
        num_simulations=sum(step.num_simulations for step in steps),
        num_missing=sum(step.num_missing for step in steps),
        notes=tuple(dict.fromkeys(note for step in steps for note in step.notes)),
        steps=tuple(steps),
    )


def pricing(
    cost: Callable[[Tensor], Tensor] | Tensor | None, actions: ActionSpace
) -> Callable[[Tensor], Tensor] | None:
    """Return the cost as a function of actions (n, action_dim) -> (n,), float64.

    The cost may be given as one number for each action of a list, shape (a,).

    Raises:
        ValueError: If the shape is another, or when called if a cost is not positive.
    """
    if cost is None:
        return None
    of = cost if callable(cost) else _listed_cost(torch.as_tensor(cost), actions)

    def price(action: Tensor) -> Tensor:
        given = torch.as_tensor(of(action)).double()
        if given.shape != (len(action),) or not bool((given > 0).all()):
            raise ValueError(
                f"expected positive costs of shape ({len(action)},); got shape "
                f"{tuple(given.shape)}, {given.flatten()[:4].tolist()}, ...; return "
                "one positive number an action"
            )
        return given

    return price


def _listed_cost(table: Tensor, actions: ActionSpace) -> Callable[[Tensor], Tensor]:
    values = actions.listed()
    if values is None or table.shape != (len(values),):
        raise ValueError(
            "expected a cost of shape (a,), one number an action of a list; got "
            f"shape {tuple(table.shape)} for {actions!r}; pass a function of "
            "actions (n, action_dim)"
        )
    return lambda action: table[torch.cdist(action, values).argmin(1)]
