"""Simulations at hand, such as those that the model was trained on, as a sampler."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from sbi_active.design.design import Design
from sbi_active.design.estimators.base import CandidateSimulations, Sampler
from sbi_active.design.limits import DesignLimits
from sbi_active.expected import require
from sbi_active.simulation import Outcome, Simulations


class GivenSampler(Sampler):
    """Give simulations at hand in place of further ones: half of the rows choose.

    The others report. Each action of a list has its own rows.

    Args:
        given: Simulations at hand.
        limits: Limits of the actions.
        fewest: Number of rows that a candidate needs.

    Attributes:
        action: Candidates with rows enough, shape (a, action_dim).

    Raises:
        TypeError: If the rows are no simulations, or the actions no list.
        ValueError: If no candidate has rows enough.
    """

    def __init__(
        self, given: Simulations, limits: DesignLimits, *, fewest: int = 16
    ) -> None:
        action, _ = limits.listed()
        if action is None or not isinstance(given, Simulations):
            raise TypeError(
                "expected a list of actions and Simulations(theta, action, x) at these "
                f"for simulations=; got {limits.actions!r} and {given!r:.80}; leave it "
                "out, or list the actions"
            )
        near = torch.isclose(given.action[:, None], action, rtol=1e-5, atol=1e-7)
        near = near.all(2)
        enough = near.sum(0) >= fewest
        expected = f"simulations with at least {fewest} rows of a candidate"
        advice = "pass rows at the actions of the list"
        require(bool(enough.any()), expected, "fewer of every one", advice)
        self.action, self._given, self._near = action[enough], given, near[:, enough]
        self.notes = [
            "estimated on the given simulations: too high where the model was trained "
            "on them, and more so for actions that it overfits"
        ]
        if few := int((~enough).sum()):
            self.notes.append(f"{few} candidates of fewer than {fewest} rows excluded")

    def draw(self, num_samples: int, action: Tensor) -> CandidateSimulations:
        """Return all rows twice: every other one of a candidate is left out of each."""
        given, odd = self._given, self._near.cumsum(0) % 2 == 1
        known = self._near & (given.status != Outcome.MISSING)[:, None]
        counted = torch.cat([known & odd, known & ~odd])
        x = torch.cat([given.x] * 2).expand(len(action), -1, *given.x.shape[1:])
        theta = torch.cat([given.theta] * 2)
        return CandidateSimulations(theta, action, x, missing=~counted.T)

    def of_rows(self, design: Design) -> Design:
        """Return a design whose candidates share no row, by a model that may know."""
        error = design.standard_error.hypot(design.standard_error[design.index])
        error[design.index] = 0.0
        return replace(
            design,
            bound="none",
            stopped="simulations given",
            num_samples=self._near.sum(0),
            difference_standard_error=error,
        )
