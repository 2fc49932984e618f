"""The simulations of a campaign, raw, for its belief, designs and scores alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.rounds.rows import rows_of
from sbi_active.simulation.outcomes import Outcome, Simulations
from sbi_active.simulation.workers.settings import IN_PROCESS, Workers


@dataclass(frozen=True)
class Batch:
    """What was simulated in one call; its outcomes follow from it.

    Attributes:
        theta: Parameters, shape (n, theta_dim), float32.
        action: Actions, shape (n, action_dim).
        seed: Seed of the call.
        log_proposal: Log density that theta was drawn from, shape (n,), float64.
    """

    theta: Tensor
    action: Tensor
    seed: int
    log_proposal: Tensor


class Pool:
    r"""Simulated rows, to which more are added and from which none is lost.

    Args:
        simulator: ``simulator(theta, action)``; where noise is declared, without it.
        batches: Batches of an earlier pool to go on from: their outcomes are read from
            the campaign's store, or simulated anew.
        workers: Workers that run the simulations.

    Attributes:
        batches: Simulated batches, in order.
        num_missing: Rows lost to faults of the simulator so far.
    """

    def __init__(
        self,
        simulator: Callable[..., Any],
        batches: list[Batch],
        workers: Workers = IN_PROCESS,
    ) -> None:
        self.simulator, self.workers = simulator, workers
        self.batches = batches
        self.num_missing = 0
        self._rows: list[Simulations] = []
        self._log_proposal: list[Tensor] = []

    def __len__(self) -> int:
        self._restore()
        return sum(len(rows) for rows in self._rows)

    def simulate(
        self, theta: Tensor, action: Tensor, *, seed: int, log_proposal: Tensor
    ) -> None:
        """Add rows: theta (n, theta_dim), actions (n, action_dim) and their density.

        Raises:
            SimulationError: If all rows of a first call fail.
        """
        self._restore()
        batch = Batch(theta.float(), action.float(), seed, log_proposal.double())
        self._add(batch)
        self.batches.append(batch)

    @property
    def rows(self) -> Simulations:
        """All rows that no fault hit, raw, in the order of simulation."""
        self._restore()
        if len(self._rows) > 1:  # once joined they stay so
            parts = [(r.theta, r.action, r.x, r.status) for r in self._rows]
            theta, action, x, status = map(torch.cat, zip(*parts, strict=True))
            self._rows = [Simulations(theta, action, x, status)]
            self._log_proposal = [torch.cat(self._log_proposal)]
        return self._rows[0]

    def at(self, action: Tensor) -> Simulations:
        """Return the rows of one action, shape (action_dim,)."""
        near = torch.isclose(self.rows.action, action.float(), rtol=1e-5, atol=1e-7)
        return self.rows.at(near.all(1))

    def weights(self, belief: Distribution) -> Tensor:
        r"""Return weights of all rows for a belief, shape (n,), that sum to one.

        .. math::
            w_i \propto b(\theta_i) / q_i(\theta_i),

        each row's own proposal in the denominator, as in :func:`.reuse`.
        """
        log_weight = belief.log_prob(self.rows.theta).double()
        log_weight = log_weight - self._log_proposal[0]
        return log_weight.nan_to_num(nan=-torch.inf).softmax(0)

    def _restore(self) -> None:
        """Bring back the rows of an earlier pool."""
        if not self._rows:
            for batch in self.batches:
                self._add(batch)

    def _add(self, batch: Batch) -> None:
        drawn = rows_of(
            *(self.simulator, batch.theta, batch.action, batch.seed, self.workers),
            is_first=not self._rows,
        )
        if drawn is None:
            self.num_missing += len(batch.theta)
            return
        known = drawn.status != Outcome.MISSING
        self.num_missing += int((~known).sum())
        self._rows.append(drawn.without_missing())
        self._log_proposal.append(batch.log_proposal[known])
