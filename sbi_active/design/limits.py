"""Actions that a designer may choose, and what they cost."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from sbi_active.actions import ActionSpace
from sbi_active.expected import require
from sbi_active.simulation.conditions import parameters_of

#: Cost of actions (n, action_dim), shape (n,), by these and the action executed before,
#: or by these alone.
Cost = Callable[..., Tensor]


class DesignLimits:
    """Limits and costs of the actions that may be chosen.

    Args:
        actions: The space.
        constraint: Function of actions (n, action_dim) that says which are permitted,
            shape (n,), bool; None permits all.
        price: Cost of actions (n, action_dim), shape (n,), which may depend on the
            action executed before, ``price(action, previous)``; None for none.
        least: Share of measurements that a choice needs.

    Attributes:
        is_sequential: Whether the cost depends on the action executed before.
        previous: That action, shape (action_dim,); None before any.
        left: Largest cost of an action.
    """

    def __init__(
        self,
        actions: ActionSpace,
        constraint: Callable[[Tensor], Tensor] | None = None,
        price: Cost | None = None,
        least: float = 0.0,
    ) -> None:
        self.actions, self.constraint, self.least = actions, constraint, least
        self._price: Any = price
        self.is_sequential = takes_second(price, "previous")
        self.previous: Tensor | None = None
        self.left = math.inf

    def after(self, previous: Tensor | None, left: float = math.inf) -> DesignLimits:
        """Return the limits of a trial after another, with what is left to spend.

        Args:
            previous: Action executed before, shape (action_dim,); None for none.
            left: Largest cost of an action.
        """
        own = copy.copy(self)
        own.previous, own.left = previous, left
        return own

    @property
    def price(self) -> Callable[[Tensor], Tensor] | None:
        """Cost of actions (n, action_dim) after the one before; None for none."""
        if not self.is_sequential:
            return self._price
        return lambda action: self._price(action, self.previous)

    def __call__(self, action: Tensor) -> Tensor:
        """Return a mask of permitted actions (n, action_dim), shape (n,), bool."""
        inside = self.actions.permits(action)
        if self.constraint is not None:
            answer = torch.as_tensor(self.constraint(action))
            if answer.shape != inside.shape:
                raise ValueError(
                    f"expected a constraint that maps actions {tuple(action.shape)} to "
                    f"({len(action)},), bool; got shape {tuple(answer.shape)}; "
                    "return one answer a row"
                )
            inside = inside & answer.bool()
        if self.left < math.inf:
            inside = inside & (self.cost(action) <= self.left)
        return inside

    def listed(self) -> tuple[Tensor | None, tuple[str, ...]]:
        """Return the permitted actions of a list, and how many are not.

        Raises:
            ValueError: If none is.
        """
        values = self.actions.listed()
        if values is None:
            return None, ()
        inside = self(values)
        got = f"none of {len(values)}"
        require(bool(inside.any()), "a permitted action", got, "loosen constraint=")
        out = int((~inside).sum())
        note = f"{out} of {len(values)} candidates not permitted"
        return values[inside], (note,) if out else ()

    def drawn(self, seed: int | None, num_draws: int = 1_024) -> Tensor:
        """Return the permitted among draws of a space without end.

        Without a seed they go on with torch's global generator.
        """
        drawn = self.actions.sample((num_draws,), seed=seed)
        drawn = drawn[self(drawn)]
        expected = f"a constraint that permits a part of {self.actions!r}"
        got = f"none of {num_draws} actions"
        advice = "narrow the space to about what it permits"
        require(len(drawn) > 0, expected, got, advice)
        return drawn

    def cost(self, action: Tensor) -> Tensor:
        """Return the cost of actions (n, action_dim), shape (n,); 1 for none.

        Raises:
            ValueError: If the shape is another, or a cost is not positive.
        """
        if self.price is None:
            return torch.ones(len(action)).double()
        given = torch.as_tensor(self.price(action)).double()
        if given.shape != (len(action),) or not bool((given > 0).all()):
            raise ValueError(
                f"expected positive costs of shape ({len(action)},); got shape "
                f"{tuple(given.shape)}, {given.flatten()[:4].tolist()}, ...; return "
                "one positive number an action"
            )
        return given

    def reached_by(self, valid: Tensor) -> Tensor:
        """Return a mask of sufficient shares of measurements, shape (a,).

        They are NaN where every simulation was lost.

        Raises:
            ValueError: If none does; it names the largest share.
        """
        eligible, most = valid >= self.least, float(valid.nan_to_num(0.0).max())
        if not bool(eligible.any()):
            raise ValueError(
                "expected a candidate that gives a measurement with a probability of "
                f"at least {self.least:g}; got {most:.3g} at most, 0 where every row "
                "was lost to faults; look at the simulator's tracebacks, lower "
                "min_probability_valid or add gentler candidates"
            )
        return eligible

    def excluded_note(self, eligible: Tensor) -> tuple[str, ...]:
        """Return a note on the number of excluded candidates; empty if none is."""
        num, least = int((~eligible).sum()), f"{self.least:g}"
        note = (
            f"{num} of {len(eligible)} candidates excluded: a measurement is less "
            f"probable than {least}, or every simulation was lost"
        )
        return (note,) if num else ()


def takes_second(function: Any, name: str = "") -> bool:
    """Whether a function needs a second argument, or has one of a name."""
    own = [p for p in parameters_of(function) if p.kind < p.VAR_POSITIONAL]
    needed = [p for p in own if p.default is p.empty]
    return len(needed) > 1 or name in [p.name for p in own]
