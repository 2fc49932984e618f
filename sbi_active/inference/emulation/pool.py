"""Simulations, raw, for belief, designs and scores, and as a trial sees them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.arrays import Array
from sbi_active.inference.emulation.outcomes import Summary
from sbi_active.inference.rounds.rows import rows_of
from sbi_active.inference.sampling.coordinates import PriorCoordinates
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
        past: Rows that are known already; their proposals are not.

    Attributes:
        batches: Simulated batches, in order.
        num_drawn: Rows simulated so far, those lost to faults among them.
        num_missing: Rows lost to faults of the simulator so far.
    """

    def __init__(
        self,
        simulator: Callable[..., Any],
        batches: list[Batch],
        workers: Workers = IN_PROCESS,
        past: Simulations | None = None,
    ) -> None:
        self.simulator, self.workers = simulator, workers
        self.batches = batches
        self.num_drawn = self.num_missing = 0
        self._rows: list[Simulations] = [] if past is None else [past]
        unknown = [torch.full((len(rows),), torch.nan) for rows in self._rows]
        self._log_proposal = [each.double() for each in unknown]

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

    def aside(self, theta: Tensor, action: Tensor, *, seed: int) -> Array:
        """Return outcomes (n, q) that do not join the rows; NaN where one is lost.

        Args:
            theta: Parameters, shape (n, theta_dim).
            action: Actions, shape (n, action_dim).
            seed: Seed of the call.
        """
        self.num_drawn += len(theta)
        rows = rows_of(
            *(self.simulator, theta.float(), action, seed, self.workers),
            is_first=False,
        )
        if rows is None:
            self.num_missing += len(theta)
            return np.full((len(theta), self.rows.x[0].numel()), np.nan)
        lost = rows.status == Outcome.MISSING
        self.num_missing += int(lost.sum())
        x = rows.x.double().flatten(1)
        return torch.where(lost[:, None], torch.nan, x).numpy()

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
        self.num_drawn += len(batch.theta)
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


@dataclass(frozen=True)
class EmulatedTrial:
    """A real trial.

    Attributes:
        action: Executed, as simulated, shape (action_dim,).
        x: Raw outcome, shape x_shape.
        label: Label of the summary of the outcome; None takes the best.
        further_noise: Deviations of noise to add to simulated numbers, shape (k,).
    """

    action: Tensor
    x: Tensor
    label: str | None = None
    further_noise: Array | None = None

    def noisier(self, numbers: Array, rng: np.random.Generator) -> Array:
        """Return simulated numbers (n, k) with the further noise."""
        if self.further_noise is None:
            return numbers
        return numbers + self.further_noise * rng.standard_normal(numbers.shape)


@dataclass(frozen=True)
class TrialRows:
    """Simulations of a trial's action.

    Attributes:
        action: The action, shape (action_dim,).
        z: Coordinates of the parameters, shape (n, d).
        x: Numbers that were observed, of each simulation, shape (n, q).
        observed: Numbers that were observed, shape (q,).
        used: Which numbers of the outcome were observed, shape (k,).
        agrees: Which simulations have a measurement, or none, as observed, shape (n,).
        pairs: Rows of the same parameters, one after the other, shape (r, 2).
    """

    action: Tensor
    z: Array
    x: Array
    observed: Array
    used: NDArray[np.bool_]
    agrees: NDArray[np.bool_]
    pairs: NDArray[np.intp]

    @property
    def share_invalid(self) -> float:
        """Share of the simulations without the numbers that were observed."""
        return float((~self.agrees if self.used.any() else self.agrees).mean())


def rows_seen(
    pool: Pool,
    coordinates: PriorCoordinates,
    trial: EmulatedTrial,
    summary: Summary,
    rng: np.random.Generator,
) -> TrialRows:
    """Return the simulations of a trial's action.

    Args:
        pool: Pool of raw simulations.
        coordinates: Coordinates of the prior.
        trial: The trial.
        summary: Summary that the outcome is seen by.
        rng: Source of further noise.
    """
    found = pool.at(trial.action)
    observed, numbers = summary(trial.x[None].float())[0], summary(found.x)
    # Where nothing was measured on one side, that is one NaN.
    width = max(numbers.shape[1], len(observed))
    numbers = trial.noisier(np.broadcast_to(numbers, (len(numbers), width)), rng)
    observed = np.broadcast_to(observed, width)
    used, known = np.isfinite(observed), np.isfinite(numbers)
    # As the trial had a measurement, or none.
    agrees = known[:, used].all(1) if used.any() else ~known.any(1)
    return TrialRows(
        action=trial.action,
        z=coordinates.to_z(found.theta),
        x=numbers[:, used],
        observed=observed[used],
        used=used,
        agrees=np.asarray(agrees),
        pairs=pairs_of(found.theta),
    )


def pairs_of(theta: Tensor) -> NDArray[np.intp]:
    """Return rows of the same parameters, one after the other, shape (r, 2)."""
    label = np.unique(theta.numpy(), axis=0, return_inverse=True)[1].reshape(-1)
    order = np.argsort(label, kind="stable")
    same = np.flatnonzero(np.diff(label[order]) == 0)
    return np.stack([order[same], order[same + 1]], 1)


def noise_sds(pool: Pool, trials: Sequence[EmulatedTrial]) -> Array:
    """Return deviations of the noise by repeated simulations, shape (t, k)."""
    found = []
    for trial in trials:
        rows = pool.at(trial.action)
        first, second = pairs_of(rows.theta).T
        gap = (rows.x[first] - rows.x[second]).double().flatten(1)
        found.append((0.5 * gap.square()).nanmean(0).nan_to_num().sqrt().numpy())
    return np.stack(found)
