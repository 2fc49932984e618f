"""What the loop is given of a case, and how it is run on it."""

from __future__ import annotations

import copy
import functools
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from sbi.utils import BoxUniform
from torch import Tensor

from sbi_active import DiscreteActions, SimulatorModel
from sbi_active.criticism import Criticism, Effect, Report, Trials, close_loop

Row = dict[str, object]


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

    def counted_report(self, seed: int, **options: Any) -> tuple[Report, Row]:
        """Return the report and what it cost."""
        model, count = counted(self.model)
        start = time.process_time()
        report = replace(self, model=model).report(seed, **options)
        seconds = time.process_time() - start
        return report, {"trial_simulations": count(), "cpu_seconds": seconds}


def counted(model: SimulatorModel) -> tuple[SimulatorModel, Callable[[], int]]:
    """Return a copy of the model that counts its rows, and how to read the count."""
    rows, fn = 0, model.fn

    @functools.wraps(fn)
    def counting(theta: Tensor, *arguments: Any, **keywords: Any) -> Any:
        nonlocal rows
        rows += len(theta)
        return fn(theta, *arguments, **keywords)

    twin = copy.copy(model)
    twin.fn = counting
    return twin, lambda: rows


def named(report: Report) -> tuple[str, ...]:
    """Return the effects given as a cause; of a model that fits, those that help."""
    tracing = report.tracing
    return tracing.chosen if tracing.misfit is None else tracing.misfit.named
