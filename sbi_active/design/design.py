"""The design that a designer returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from sbi_active.design.estimators.base import Bound
from sbi_active.display.figures import legible
from sbi_active.display.panels import plot_design

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class Design:
    """The chosen action and the estimates behind the choice.

    Attributes:
        action: The chosen action, shape (action_dim,), or the chosen batch, shape
            (num_actions, action_dim).
        candidates: All candidates that were compared at last, shape (a, action_dim).
            For a batch, all that follows describes its last action: what it tells
            beyond the others.
        expected_information_gain: Estimates on simulations that had no part in the
            choice, nats, shape (a,); NaN for a random choice.
        standard_error: Standard error of each estimate, shape (a,).
        difference_standard_error: Standard error of each estimate's difference to the
            chosen candidate's, on common random numbers, shape (a,); zero at the chosen
            one.
        probability_best: Probability that a candidate has the largest expectation of
            the estimate, by its cost if there is one, given the simulations, shape
            (a,); zero if a candidate is excluded.
        probability_valid: Share of the simulations of each candidate that gave a
            measurement, partly observed ones included, shape (a,). Rows lost to a fault
            do not count; NaN where nothing else is left.
        bound: Side of the information that the estimates lie on.
        index: Index of the chosen candidate.
        num_simulations: Simulations spent.
        labels: Names of the action's entries, with their units.
        estimator: Class that estimated.
        num_samples: Simulations of each candidate, shape (a,). Candidates that were
            eliminated early have fewer.
        stopped: Reason why no further simulations were run: "leader separated",
            "difference negligible", "budget spent" or "simulations given".
        num_missing: Simulations of them all that were lost to faults of the simulator.
        notes: Notes on the estimates: estimators that failed a check or disagree, where
            an estimate is a bound, candidates that were excluded.
        cost: Cost of each candidate, shape (a,); None if there is none.
        steps: Designs of the actions of a batch in turn, each given the former and the
            pending ones; empty for a single action.
    """

    action: Tensor
    candidates: Tensor
    expected_information_gain: Tensor
    standard_error: Tensor
    difference_standard_error: Tensor
    probability_best: Tensor
    probability_valid: Tensor
    bound: Bound
    index: int
    num_simulations: int
    estimator: str = "none"
    num_samples: Tensor = field(default_factory=lambda: torch.empty(0).long())
    stopped: str = "at random"
    num_missing: int = 0
    notes: tuple[str, ...] = ()
    cost: Tensor | None = None
    steps: tuple[Design, ...] = ()
    labels: tuple[str, ...] = ()

    @property
    def utility(self) -> Tensor:
        """Expected information gain by cost, nats a unit of cost, shape (a,)."""
        if self.cost is None:
            return self.expected_information_gain
        return self.expected_information_gain / self.cost

    @property
    def joint_information_gain(self) -> float:
        """Joint information gain of the action or batch beyond pending trials, nats."""
        steps = self.steps or (self,)
        return sum(float(s.expected_information_gain[s.index]) for s in steps)

    def __repr__(self) -> str:
        if self.steps:
            gain = self.joint_information_gain
            return f"Design({len(self.steps)} actions, joint EIG {gain:.2f} nats)"
        action = ", ".join(f"{v:g}" for v in self.action.tolist())
        if self.expected_information_gain.isnan().all():
            return f"Design(action [{action}], at random)"
        gain = float(self.expected_information_gain[self.index])
        error = float(self.standard_error[self.index])
        return f"Design(action [{action}], EIG {gain:.2f} +- {error:.2f} nats)"

    def plot(self, ax: Axes | None = None) -> Axes:
        """Plot the expected information gain of the candidates.

        The plot is over one entry of the action with two standard errors, over two as a
        map with the candidates that were evaluated; of more the candidates stand in
        order, the best first.

        Args:
            ax: Axes to draw on; None makes a figure.
        """
        drawn: Any = plot_design(self, ax)
        legible(drawn.get_figure(root=True))
        return drawn


def unknown_errors(num: int) -> dict[str, Any]:
    """Return errors and shares of a :class:`Design` of so many candidates, all NaN."""
    kinds = "standard_error", "difference_standard_error"
    shares = "probability_best", "probability_valid"
    return dict.fromkeys(kinds + shares, torch.full((num,), torch.nan).double())
