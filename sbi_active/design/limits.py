"""Actions that a designer may choose, and what they cost."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sbi_active.actions import ActionSpace
from sbi_active.expected import require
from sbi_active.simulation.conditions import parameters_of

#: Cost of actions (n, action_dim), shape (n,), by these and the action executed before,
#: or by these alone.
Cost = Callable[..., Tensor]


@dataclass(frozen=True)
class DesignLimits:
    """Limits and costs of the actions that may be chosen.

    Attributes:
        actions: The space.
        constraint: Function of actions (n, action_dim) that says which are permitted,
            shape (n,), bool; None permits all.
        cost_of: Cost of actions (n, action_dim), shape (n,), which may depend on the
            action executed before, ``cost_of(action, previous)``; None for none.
        least: Share of measurements that a choice needs.
        previous: Action executed before, shape (action_dim,); None before any.
        left: Largest cost of an action.
    """

    actions: ActionSpace
    constraint: Callable[[Tensor], Tensor] | None = None
    cost_of: Cost | None = None
    least: float = 0.0
    previous: Tensor | None = None
    left: float = math.inf

    @property
    def is_sequential(self) -> bool:
        """Whether the cost depends on the action executed before."""
        return takes_second(self.cost_of, "previous")

    @property
    def price(self) -> Callable[[Tensor], Tensor] | None:
        """Cost of actions (n, action_dim) after the one before; None for none."""
        cost: Any = self.cost_of
        if not self.is_sequential:
            return cost
        return lambda action: cost(action, self.previous)

    def __call__(self, action: Tensor) -> Tensor:
        """Return a mask of permitted actions (n, action_dim), shape (n,), bool."""
        inside = self.actions.permits(action)
        if self.constraint is not None:
            answer = torch.as_tensor(self.constraint(action))
            expected = f"a constraint that maps {(*action.shape,)} to ({len(action)},)"
            fits, got = answer.shape == inside.shape, f"shape {(*answer.shape,)}"
            require(fits, expected, got, "return one bool a row")
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
        fits = given.shape == (len(action),) and bool((given > 0).all())
        expected = f"positive costs of shape ({len(action)},)"
        got = f"shape {(*given.shape,)}, {given.flatten()[:4].tolist()}, ..."
        require(fits, expected, got, "return one positive number an action")
        return given

    def reached_by(self, valid: Tensor) -> Tensor:
        """Return a mask of sufficient shares of measurements, shape (a,).

        They are NaN where every simulation was lost.

        Raises:
            ValueError: If none does; it names the largest share.
        """
        eligible, most = valid >= self.least, float(valid.nan_to_num(0.0).max())
        require(
            bool(eligible.any()),
            f"a candidate measured with a probability of at least {self.least:g}",
            f"{most:.3g} at most, 0 where every row was lost to faults",
            "look at the simulator's tracebacks, lower min_probability_valid or add "
            "gentler candidates",
        )
        return eligible

    def excluded_note(self, eligible: Tensor) -> tuple[str, ...]:
        """Return a note on the number of excluded candidates; empty if none is."""
        num = int((~eligible).sum())
        note = f"{num} of {len(eligible)} candidates excluded: a measurement is less "
        note += f"probable than {self.least:g}, or every simulation was lost"
        return (note,) if num else ()


def takes_second(function: Any, name: str = "") -> bool:
    """Whether a function needs a second argument, or has one of a name."""
    own = [p for p in parameters_of(function) if p.kind < p.VAR_POSITIONAL]
    needed = [p for p in own if p.default is p.empty]
    return len(needed) > 1 or name in [p.name for p in own]
