"""The machines of the misfit benchmark, that run trials which a design asks for."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.misfit.cases import Case
from benchmarks.misfit.truth import Truth
from sbi_active import DiscreteActions
from sbi_active.seeding import derive_seed, forked_generators

#: Permitted actions of a case, drawn as those of the trials were.
NUM_PERMITTED = 32


@dataclass
class Reality:
    """The truth of a case, one trial after another.

    A trial has the discrepancy that was drawn for its place in the order of execution;
    after the last place, that of an early trial that was held out.

    Attributes:
        case: Case whose truth it is.
        actions: Permitted actions.
        index: Place of the next trial.
    """

    case: Case
    actions: DiscreteActions
    index: int

    @classmethod
    def of(cls, case: Case, number: int) -> Reality:
        """Return the reality of a case before any further trial.

        Args:
            case: The case.
            number: Its number.
        """
        truth = case.truth
        with forked_generators(derive_seed(number, "permitted")):
            permitted = truth.machine.draw_actions(NUM_PERMITTED)
        return cls(case, DiscreteActions(permitted), int(truth.fitted.max()) + 1)

    def run(self, action: Tensor) -> Tensor:
        """Return what the sensor reads at an action."""
        truth, k = _long_enough(self.case.truth, self.index), self.index
        actions = truth.action.clone()
        actions[k] = action.to(actions)
        truth = replace(truth, action=actions, discrepancy=_at(truth, actions, k))
        self.index += 1
        return truth.measured(torch.tensor([k]))[0]


def _long_enough(truth: Truth, k: int) -> Truth:
    """Return the truth with places up to one of this index."""
    n = len(truth.action)
    more = max(k + 1 - n, 0)
    if not more:
        return truth
    early = truth.held_out[:more]
    changed: dict[str, Any] = {"action": torch.cat([truth.action, truth.action[early]])}
    with forked_generators(derive_seed(n, "sensor", truth.machine.name)):
        error = torch.randn(more, *truth.error.shape[1:], dtype=torch.float64)
    changed["error"] = torch.cat([truth.error, truth.machine.noise_sd * error])
    what = truth.discrepancy
    if what is not None and len(what.series) == n and what.series.shape[1]:
        series = torch.cat([what.series, what.series[early]])
        changed["discrepancy"] = replace(what, series=series)
    return replace(truth, **changed)


def _at(truth: Truth, actions: Tensor, k: int):
    """Return the discrepancy where trial k has another action than was drawn for it.

    Without a time axis a process follows the action: between those drawn it is linear.
    """
    what = truth.discrepancy
    if what is None or what.kind != "process" or truth.machine.times is not None:
        return what
    drawn = [i for i in range(len(truth.action)) if i != k]
    drawn.sort(key=lambda i: float(truth.action[i, 0]))
    place, value = truth.action[drawn, 0].numpy(), what.series[drawn, 0].numpy()
    series = what.series.clone()
    series[k, 0] = float(np.interp(float(actions[k, 0]), place, value))
    return replace(what, series=series)


def spread_out(reality: Reality, num: int) -> Tensor:
    """Return the permitted actions that are farthest from all others, one by one.

    Args:
        reality: Reality, whose trials were run already.
        num: Number of actions.
    """
    values = reality.actions.values.double()
    low, high = values.min(0).values, values.max(0).values
    tried = reality.case.problem.trials.action.double()
    found: list[Tensor] = []
    for _ in range(num):
        done = torch.cat([tried, *[a[None] for a in found]])
        distance = torch.cdist(values / (high - low), done / (high - low))
        found.append(values[distance.min(1).values.argmax()])
    return torch.stack(found)
