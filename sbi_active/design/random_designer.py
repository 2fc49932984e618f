"""Choose the next action at random."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions.discrete import Actions, action_space
from sbi_active.design.design import Design, unknown_errors
from sbi_active.design.limits import DesignLimits
from sbi_active.expected import Shown, suggests
from sbi_active.seeding import derive_seed, forked_generators


class RandomDesigner(Shown):
    """Choose an action uniformly at random, the design of NSBI and NLHI.

    Args:
        actions: The action space, or a list of actions.
    """

    @suggests
    def __init__(self, actions: Actions) -> None:
        self.actions = action_space(actions)

    @suggests
    def select(
        self,
        model: Any = None,
        simulator: Callable[..., Any] | None = None,
        *,
        belief: Distribution | None = None,
        constraint: Callable[[Tensor], Tensor] | None = None,
        seed: int | None = None,
    ) -> Design:
        """Return a random action; nothing is simulated.

        Args:
            model: Model, which is not used; it, the simulator and the belief stand
                where another designer takes them.
            simulator: Simulator, which is not used.
            belief: Belief, which is not used.
            constraint: Function of actions (n, action_dim) that says which are
                permitted, shape (n,), bool.
            seed: Seed of the choice; None draws one from torch's global generator.

        Returns:
            The design. In an infinite space the only candidate is the action drawn.

        Raises:
            ValueError: If no action is permitted.
        """
        limits = DesignLimits(self.actions, constraint)
        candidates, notes = limits.listed()
        if candidates is None:
            own = None if seed is None else derive_seed(seed, "candidates")
            candidates = limits.drawn(own)[:1]
        num = len(candidates)
        with forked_generators(seed):
            chosen = int(torch.randint(num, ()))
        return Design(
            action=candidates[chosen],
            candidates=candidates,
            expected_information_gain=torch.full((num,), torch.nan).double(),
            **unknown_errors(num),
            bound="none",
            index=chosen,
            num_simulations=0,
            labels=self.actions.entry_labels,
            num_samples=torch.zeros(num).long(),
            notes=notes,
        )
