"""Simulated histories: every executed action at each of many parameter sets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sbi_active.arrays import Array
from sbi_active.inference.regression.outcomes import outcomes_of
from sbi_active.inference.regression.regions import Region
from sbi_active.inference.regression.residuals import ShapeSettings
from sbi_active.inference.regression.surrogate import (
    LocalRegression,
    fewest_rows,
    noise_variance,
)
from sbi_active.inference.rounds.rows import rows_of
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.seeding import derive_seed
from sbi_active.simulation.outcomes import Outcome
from sbi_active.simulation.simulator import require_noise
from sbi_active.simulation.workers.settings import IN_PROCESS, Workers

LOST = np.inf  # marks the rows of a history that a fault hit


@dataclass(frozen=True)
class HistoryRecord:
    """Simulated histories to go on from when a further trial is known.

    Rows of equal parameters repeat each other.

    Attributes:
        action: The executed actions, shape (t, action_dim).
        theta: Parameters, shape (n, d), float32.
        x: Outcomes, shape (n, t, q); NaN where there was no measurement.
        present: Which of them were there at the first attempt, shape (n, t, q).
        is_overview: Which rows were drawn from the whole prior, shape (n,).
    """

    action: Tensor
    theta: Tensor
    x: Array
    present: NDArray[np.bool_]
    is_overview: NDArray[np.bool_]


class Histories:
    """A growing pool of histories, some of them simulated twice.

    Args:
        simulator: ``simulator(theta, action)``.
        action: Executed actions, shape (t, action_dim).
        x: Observed outcomes, shape (t, q); NaN where nothing was.
        coordinates: Coordinates of the prior.
        seed: Seed of the simulations.
        past: Histories of the first of these trials; those that are still of use are
            simulated at the further actions only.
        workers: Workers that run the simulations.
        further_noise: Standard deviations of noise to add to each trial's outcomes,
            shape (t, q); None adds none.

    Attributes:
        z: Coordinates of the parameters, shape (n, d).
        x: Outcomes less the observed ones, or themselves where nothing was observed,
            shape (n, t * q).
        present: Which outcomes were there at the first attempt, shape (n, t, q).
        observed: Observed numbers, zero where nothing was, shape (t * q,).
        used: Which numbers were observed, shape (t * q,).
        num_drawn: Histories simulated here or taken over, those lost to faults of the
            simulator included.
        num_missing: Rows lost to faults of the simulator; each loses its history.
        num_simulations: Rows simulated here.
    """

    def __init__(
        self,
        simulator: Callable[..., Any],
        action: Tensor,
        x: Array,
        coordinates: PriorCoordinates,
        seed: int,
        past: HistoryRecord | None = None,
        workers: Workers = IN_PROCESS,
        *,
        further_noise: Array | None = None,
    ) -> None:
        self.simulator, self.action = simulator, action
        self.workers, self.further_noise = workers, further_noise
        self._seen = np.isfinite(x)
        self.used = self._seen.reshape(-1)
        self.observed = np.where(self._seen, x, 0.0).reshape(-1)
        self.coordinates, self.seed = coordinates, seed
        self.z = np.zeros((0, coordinates.dim))
        self.x = np.zeros((0, x.size))
        self.present = np.zeros((0, *x.shape), dtype=bool)
        self.num_simulations = self.num_drawn = self.num_missing = 0
        self._theta = torch.zeros(0, coordinates.dim)
        self._is_overview = np.zeros(0, dtype=bool)
        if past is not None and not torch.equal(
            past.action, action[: len(past.action)]
        ):
            past = None  # its trials are not the first of these
        self._past = past
        self._unused = np.ones(0 if past is None else len(past.theta), dtype=bool)

    def __len__(self) -> int:
        return len(self.z)

    def add(self, z: Array, num_replicates: int, *, is_overview: bool = False) -> None:
        """Simulate at z, shape (n, d), and again at the first few of them.

        Overview rows are those drawn from the whole prior.
        """
        theta = self.coordinates.to_theta(np.concatenate([z, z[:num_replicates]]))
        x, present = self._simulate(theta, 0)
        if self.num_drawn == 0:
            again = torch.from_numpy(x[len(z) :])
            require_noise(torch.from_numpy(x[:num_replicates]), again)
        self._append(theta, x, present, is_overview=is_overview)

    def reuse(self, region: Region, count: int, *, is_overview: bool = False) -> int:
        """Take past histories in a region, simulated at the further actions only.

        At most ``count``, each followed by those that repeat it, which tell the noise.
        For an overview those drawn from the whole prior instead, so that a first stage
        keeps its distribution. Returns how many were added.
        """
        past = self._past
        if past is None or count <= 0:
            return 0
        eligible = past.is_overview
        if not is_overview:
            eligible = region.distance(self.coordinates.to_z(past.theta)) <= 1
        _, first, of = np.unique(
            past.theta.numpy(), axis=0, return_index=True, return_inverse=True
        )
        first = first[of.reshape(-1)]  # the row that each row repeats, or itself
        rows = np.flatnonzero(eligible & self._unused)
        rows = rows[np.argsort(first[rows], kind="stable")][:count]
        if len(rows) == 0:
            return 0
        self._unused[rows] = False
        theta, known = past.theta[torch.from_numpy(rows)], len(past.action)
        x, present = past.x[rows], past.present[rows]
        if known < len(self.action):
            further = self._simulate(theta, known)
            x = np.concatenate([x, further[0]], 1)
            present = np.concatenate([present, further[1]], 1)
        self._append(theta, x, present, is_overview=is_overview)
        return len(rows)

    def fresh(self, theta: Tensor) -> tuple[Array, NDArray[np.bool_]]:
        """Return outcomes less the observed ones (n, t * q), and which rows lack some.

        They do not join the histories.

        Args:
            theta: Parameters, shape (n, d).
        """
        x = self._simulate(theta, 0, enough=0.9)[0]  # few are judged by
        x = x.reshape(len(theta), -1) - self.observed
        return x, ~np.isfinite(x[:, self.used]).all(1) | (x == LOST).any(1)

    def record(self) -> HistoryRecord:
        """Return the histories for a later call with further trials."""
        x = (self.x + self.observed).reshape(self.present.shape)
        return HistoryRecord(
            self.action, self._theta, x, self.present, self._is_overview
        )

    def _simulate(
        self,
        theta: Tensor,
        first: int,
        *,
        most: int = 16,
        enough: float = 0.5,
        num_probes: int = 50,
        worthwhile: float = 0.05,
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Return outcomes at each theta of the trials from ``first`` on.

        And which of them were there at the first attempt, both of shape (n, t, q).
        Where chance decides who gives a measurement, histories of many trials would
        seldom be complete; given one, x has the same law at any attempt. So up to
        ``most`` more are made until a share is ``enough``, if a few probes show that
        they are ``worthwhile``.
        """
        n, t = len(theta), len(self.action) - first
        seed = derive_seed(self.seed, "histories", self.num_simulations)
        trial = torch.arange(first, len(self.action)).repeat(n)
        place = torch.arange(n).repeat_interleave(t)
        x = self._rows(theta[place], trial, seed)
        present = np.isfinite(x)
        for attempt in range(most):
            lacks = (self._seen[trial] & np.isnan(x)).any(1)
            rows = np.flatnonzero(lacks)
            if (~lacks.reshape(n, t).any(1)).mean() >= enough or not len(rows):
                break
            if attempt == 0:  # a few show whether it is chance at all
                rows = rows[:: max(len(rows) // num_probes, 1)]
            again = self._rows(
                theta[place[rows]], trial[rows], derive_seed(seed, attempt)
            )
            filled = (np.isfinite(again) | ~self._seen[trial[rows]]).all(1)
            x[rows[filled]] = again[filled]
            if filled.mean() < worthwhile:
                break
        return x.reshape(n, t, -1), present.reshape(n, t, -1)

    def _rows(self, theta: Tensor, trial: Tensor, seed: int) -> Array:
        """Return outcomes (n, q) of theta (n, d) at the actions of trials (n,).

        NaN stands for no number, LOST for faults.
        """
        is_first, size = self.num_simulations == 0, self._seen.shape[1]
        self.num_simulations += len(theta)
        rows = rows_of(
            *(self.simulator, theta, self.action[trial], seed, self.workers),
            is_first=is_first,
        )
        if rows is None:
            self.num_missing += len(theta)
            return np.full((len(theta), size), LOST)
        x = rows.x.double().flatten(1).numpy()
        if x.shape[1] != size:
            raise ValueError(
                f"expected simulated x of shape {tuple(rows.x.shape[1:])} a row, as "
                f"observed; got {size} observed numbers a trial; "
                "pass x (t, *x_shape) of the simulator's shape"
            )
        x = np.where(np.isfinite(x), x, np.nan)
        if self.further_noise is not None:
            rng = np.random.default_rng(derive_seed(seed, "further noise"))
            x = x + self.further_noise[trial.numpy()] * rng.standard_normal(x.shape)
        lost = (rows.status == Outcome.MISSING).numpy()
        self.num_missing += int(lost.sum())
        x[lost] = LOST
        return x

    def _append(
        self, theta: Tensor, x: Array, present: Array, *, is_overview: bool
    ) -> None:
        """Append histories; one that a fault hit is left out."""
        self.num_drawn += len(theta)
        kept = ~(x == LOST).any((1, 2))
        theta = theta[torch.from_numpy(kept)]
        # What was simulated is the float32 parameter.
        self.z = np.concatenate([self.z, self.coordinates.to_z(theta)])
        flat = x[kept].reshape(len(theta), -1)
        self.x = np.concatenate([self.x, flat - self.observed])
        self.present = np.concatenate([self.present, present[kept]])
        self._theta = torch.cat([self._theta, theta])
        overview = np.full(len(theta), is_overview)
        self._is_overview = np.concatenate([self._is_overview, overview])

    @property
    def pairs(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows of the same parameters, one after the other, both (r,)."""
        label = np.unique(self._theta.numpy(), axis=0, return_inverse=True)[1]
        order = np.argsort(label.reshape(-1), kind="stable")
        same = np.diff(label.reshape(-1)[order]) == 0
        return order[:-1][same], order[1:][same]

    @property
    def noise_sds(self) -> Array:
        """Standard deviations of the noise by repeated simulations, shape (t, q)."""
        first, second = self.pairs
        gap = self.x[first] - self.x[second]
        with np.errstate(all="ignore"):
            variance = np.nanmean(0.5 * gap**2, 0)
        return np.sqrt(np.nan_to_num(variance)).reshape(self._seen.shape)

    @property
    def agrees(self) -> NDArray[np.bool_]:
        """Whether each trial's outcome is of the kind observed, shape (n, t).

        That is without a measurement, as observed, or with the numbers observed.
        """
        without = ~self._seen.any(1)
        agrees = (self.present | ~self._seen).all(2)
        return np.where(without, ~self.present.any(2), agrees)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Histories that have every number observed, shape (n,)."""
        return np.asarray(np.isfinite(self.x[:, self.used]).all(1))

    @property
    def share_invalid(self) -> float:
        """Share of outcomes without a measurement."""
        return float((~self.present.any(2)).mean()) if len(self) else 0.0

    def regress(
        self,
        region: Region,
        shapes: ShapeSettings | None = None,
        *,
        min_pairs: int = 20,
    ) -> LocalRegression | None:
        """Regress the histories in a region, or the nearest where it holds few.

        With settings of noise that is not Gaussian its shape is looked at too.
        """
        distance, valid, agrees = region.distance(self.z), self.valid, self.agrees
        needed = 2 * fewest_rows(self.coordinates.dim)
        rows = _nearest(np.where(valid, distance, np.inf), needed)
        first, second = self.pairs
        both = valid[first] & valid[second]
        if len(rows) < needed // 2 or both.sum() < 5:
            return None
        pairs = _nearest(np.where(both, distance[first], np.inf), min_pairs)
        scale = np.abs(self.x[rows] + self.observed).max(0)[self.used]
        one, other = (self.x[at[pairs]][:, self.used] for at in (first, second))
        noise = noise_variance(one, other, scale)
        # Where all trials agree everywhere, or nowhere, there is nothing to compare.
        mixed = np.flatnonzero(agrees.any(0) & ~agrees.all(0))
        near = _nearest(distance, needed)
        again = np.stack([first, second], 1)[_nearest(distance[first], min_pairs)]
        outcomes = outcomes_of(
            region, self.z[near], agrees[near], agrees[again], mixed.tolist()
        )
        return LocalRegression.fit(
            region,
            self.z[rows],
            self.x[rows],
            noise=noise,
            num_pairs=len(one),
            num_trials=len(self.action),
            outcomes=outcomes,
            used=self.used,
            observed=self.observed,
            shapes=shapes,
        )


def _nearest(distance: Array, at_least: int) -> NDArray[np.intp]:
    """Return the rows within a distance of 1, or the nearest few beyond."""
    inside = np.flatnonzero(distance <= 1)
    if len(inside) >= at_least:
        return inside
    order = np.argsort(distance, kind="stable")[:at_least]
    return order[np.isfinite(distance[order])]
