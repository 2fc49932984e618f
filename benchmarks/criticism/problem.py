"""What the loop is given of a case, and how it is run on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sbi.utils import BoxUniform

from sbi_active import DiscreteActions, SimulatorModel
from sbi_active.criticism import Criticism, Effect, Report, Trials, close_loop


@dataclass(frozen=True, kw_only=True)
class Problem:
    """What the loop is given.

    Attributes:
        model: The bare simulator.
        prior: Of theta.
        trials: Measured ones, held-out ones included.
        effects: The declared library.
        actions: The permitted ones.
    """

    model: SimulatorModel
    prior: BoxUniform
    trials: Trials
    effects: list[Effect]
    actions: DiscreteActions | None = None

    def criticism(self, seed: int) -> Criticism:
        """Return the loop, step by step."""
        given = {"effects": self.effects, "actions": self.actions, "seed": seed}
        return Criticism(self.model, self.prior, self.trials, **given)

    def report(self, seed: int, **options: Any) -> Report:
        """Return the report of the loop in one call."""
        given = {"effects": self.effects, "actions": self.actions, "seed": seed}
        given |= options
        return close_loop(self.model, self.prior, self.trials, **given)
