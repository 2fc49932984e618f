"""Limits and costs of the robot's actions in a campaign."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sbi_active.actions import ActionSpace, DiscreteActions
from sbi_active.design.limits import DesignLimits, pricing


@dataclass(frozen=True)
class Limits:
    """Limits that every design of a campaign keeps.

    Attributes:
        actions: The action space.
        constraint: Function of actions (n, action_dim) that says which are permitted,
            shape (n,), bool; None permits all.
        cost: Cost of actions (n, action_dim), shape (n,), or one number an action of a
            list; None for none.
    """

    actions: ActionSpace
    constraint: Callable[[Tensor], Tensor] | None = None
    cost: Callable[[Tensor], Tensor] | Tensor | None = None

    def __post_init__(self) -> None:
        """Make a wrong shape an error here, and not in a later round."""
        self.permitted()
        some = self.actions.listed()
        self.price(self.actions.sample((8,), seed=0) if some is None else some)

    def options(self, exclude: Tensor | None) -> dict[str, Any]:
        """Return the limits as a designer takes them, without the cost.

        Args:
            exclude: Actions not to repeat, shape (t, action_dim).
        """
        return {"constraint": self.constraint, "exclude": exclude}

    def design(self, exclude: Tensor | None, least: float) -> DesignLimits:
        """Return the limits of one design.

        Args:
            exclude: Actions not to repeat, shape (t, action_dim).
            least: Share of measurements that a choice needs.
        """
        none = torch.empty(0, self.actions.action_dim)
        return DesignLimits(
            self.actions,
            self.constraint,
            none if exclude is None else exclude,
            pricing(self.cost, self.actions),
            least,
        )

    def permitted(self, exclude: Tensor | None = None) -> ActionSpace:
        """Return the space, where it is limited as a list of what is permitted.

        Args:
            exclude: Actions not to repeat, shape (t, action_dim).

        Raises:
            ValueError: If nothing is permitted.
        """
        if self.constraint is None and exclude is None:
            return self.actions
        none = torch.empty(0, self.actions.action_dim)
        allowed = DesignLimits(
            self.actions, self.constraint, none if exclude is None else exclude
        )
        values, _ = allowed.listed()
        if values is None:
            values = allowed.drawn(0)
        names, units = self.actions.names, self.actions.units
        return DiscreteActions(values, names=names, units=units)

    def price(self, action: Tensor) -> Tensor | None:
        """Return the cost of actions (n, action_dim), shape (n,); None for none.

        Raises:
            ValueError: If the shape is another, or a cost is not positive.
        """
        of = pricing(self.cost, self.actions)
        return None if of is None else of(action)
