"""Simulated histories: every executed action at each of many parameter sets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sbi_active.inference.coordinates import PriorCoordinates
from sbi_active.inference.regions import Region
from sbi_active.inference.surrogate import LocalRegression, estimate_noise
from sbi_active.seeding import derive_seed
from sbi_active.simulation.engine import simulate
from sbi_active.simulation.model import require_noise

__all__ = ["Histories", "HistoryRecord"]

Array = NDArray[Any]

MIN_PAIRS = 20  # replicates a noise estimate rests on


@dataclass(frozen=True)
class HistoryRecord:
    """Simulated histories to go on from when a further trial is known.

    Attributes:
        action: The executed actions, shape (t, action_dim).
        theta: Parameters, shape (n, d), float32.
        x: Outcomes, shape (n, t, q).
        again: Outcomes of a second simulation, NaN where there was none, (n, t, q).
        has_again: Which rows were simulated twice, shape (n,).
        is_overview: Which rows were drawn from the whole prior, shape (n,).
    """

    action: Tensor
    theta: Tensor
    x: Array
    again: Array
    has_again: NDArray[np.bool_]
    is_overview: NDArray[np.bool_]

    def precedes(self, action: Tensor) -> bool:
        """Whether these are the first trials of ``action``, shape (t', action_dim)."""
        return torch.equal(self.action, action[: len(self.action)])


class Histories:
    """A growing pool of histories, some of them simulated twice.

    Args:
        simulator: ``simulator(theta, action)``.
        action: Executed actions, shape (t, action_dim).
        x: What was observed, stacked, shape (q,).
        coordinates: Of the prior.
        seed: Of the simulations.
        past: Histories of the first of these trials; those that are still of use are
            simulated at the further actions only.

    Attributes:
        z: Coordinates of the parameters, shape (n, d).
        x: Outcomes less the observed ones, shape (n, q).
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
    ) -> None:
        self.simulator, self.action, self.observed = simulator, action, x
        self.coordinates, self.seed = coordinates, seed
        self.z = np.zeros((0, coordinates.dim))
        self.x = np.zeros((0, x.size))
        self.first: list[int] = []
        self.second: list[int] = []
        self.num_simulations = 0
        self._theta = torch.zeros(0, coordinates.dim)
        self._is_overview = np.zeros(0, dtype=bool)
        usable = past is not None and past.precedes(action)
        self._past = past if usable else None
        self._unused = np.ones(0 if past is None else len(past.theta), dtype=bool)

    def __len__(self) -> int:
        return len(self.z)

    def add(self, z: Array, num_replicates: int, *, is_overview: bool = False) -> None:
        """Simulate at z, shape (n, d), and again at the first few of them.

        Args:
            z: Coordinates of the parameters.
            num_replicates: How many of them to simulate twice.
            is_overview: Whether z is drawn from the whole prior.
        """
        theta = self.coordinates.to_theta(np.concatenate([z, z[:num_replicates]]))
        x = self._simulate(theta, self.action)
        if len(self) == 0:
            again = torch.from_numpy(x[len(z) :])
            require_noise(torch.from_numpy(x[:num_replicates]), again)
        self._append(theta, x, np.arange(num_replicates), is_overview=is_overview)

    def reuse(self, region: Region, count: int, *, is_overview: bool = False) -> int:
        """Take past histories in a region, simulated at the further actions only.

        Args:
            region: Where they must lie.
            count: How many parameter sets at most.
            is_overview: Take those drawn from the whole prior instead, so that a first
                stage keeps its distribution.

        Returns:
            How many rows were added, replicates included.
        """
        past = self._past
        if past is None or count <= 0:
            return 0
        if is_overview:
            eligible = past.is_overview
        else:
            eligible = region.distance(self.coordinates.to_z(past.theta)) <= 1
        rows = np.flatnonzero(eligible & self._unused)[:count]
        if len(rows) == 0:
            return 0
        self._unused[rows] = False
        twice = np.flatnonzero(past.has_again[rows])
        theta = torch.cat([past.theta[rows], past.theta[rows[twice]]])
        x = np.concatenate([past.x[rows], past.again[rows[twice]]]).reshape(
            len(theta), -1
        )
        further = self.action[len(past.action) :]
        if len(further):
            x = np.concatenate([x, self._simulate(theta, further)], 1)
        self._append(theta, x, twice, is_overview=is_overview)
        return len(theta)

    def record(self) -> HistoryRecord:
        """Return the histories for a later call with further trials."""
        t = len(self.action)
        x = (self.x + self.observed).reshape(len(self), t, -1)
        is_second = np.zeros(len(self), dtype=bool)
        is_second[self.second] = True
        again, has_again = np.full_like(x, np.nan), np.zeros(len(self), dtype=bool)
        again[self.first], has_again[self.first] = x[self.second], True
        keep = ~is_second
        return HistoryRecord(
            action=self.action,
            theta=self._theta[torch.from_numpy(keep)],
            x=x[keep],
            again=again[keep],
            has_again=has_again[keep],
            is_overview=self._is_overview[keep],
        )

    def _simulate(self, theta: Tensor, action: Tensor) -> Array:
        """Return the outcomes of every action at each theta, shape (n, t * q)."""
        t = len(action)
        rows = simulate(
            self.simulator,
            theta.repeat_interleave(t, 0),
            action.repeat(len(theta), 1),
            seed=derive_seed(self.seed, "histories", self.num_simulations),
        )
        self.num_simulations += len(rows)
        x = rows.x.double().numpy().reshape(len(theta), -1)
        expected = self.observed.size // len(self.action)
        if x.shape[1] != expected * t:
            raise ValueError(
                f"expected simulated x of shape {tuple(rows.x.shape[1:])} a row, as "
                f"observed; got {expected} observed numbers a trial; do pass x (t, "
                "*x_shape) of the simulator's shape"
            )
        return x

    def _append(
        self, theta: Tensor, x: Array, twice: NDArray[np.intp], *, is_overview: bool
    ) -> None:
        """Append rows of which the last are replicates of ``twice``."""
        start, num_places = len(self), len(theta) - len(twice)
        # What was simulated is the float32 parameter.
        self.z = np.concatenate([self.z, self.coordinates.to_z(theta)])
        self.x = np.concatenate([self.x, x - self.observed])
        self._theta = torch.cat([self._theta, theta])
        overview = np.full(len(theta), is_overview)
        self._is_overview = np.concatenate([self._is_overview, overview])
        self.first += (start + twice).tolist()
        self.second += range(start + num_places, start + len(theta))

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Histories in which each trial has a measurement, shape (n,)."""
        return np.asarray(np.isfinite(self.x).all(1))

    def regress(self, region: Region) -> LocalRegression | None:
        """Regress the histories in a region, or the nearest where it holds few."""
        distance, valid = region.distance(self.z), self.valid
        needed = 2 * (self.coordinates.dim + 21)
        rows = _nearest(np.where(valid, distance, np.inf), needed)
        inside = distance <= 1
        log_valid = np.log((inside & valid).sum() + 1.0) - np.log(inside.sum() + 2.0)
        first, second = np.array(self.first), np.array(self.second)
        both = valid[first] & valid[second]
        if len(rows) < needed // 2 or both.sum() < 5:
            return None
        pairs = _nearest(np.where(both, distance[first], np.inf), MIN_PAIRS)
        scale = np.abs(self.x[rows] + self.observed).max(0)
        noise = estimate_noise(self.x[first[pairs]], self.x[second[pairs]], scale)
        return LocalRegression.fit(
            region,
            self.z[rows],
            self.x[rows],
            noise=noise,
            num_trials=len(self.action),
            log_valid=float(log_valid) if not valid.all() else 0.0,
        )


def _nearest(distance: Array, at_least: int) -> NDArray[np.intp]:
    """Return the rows within a distance of 1, or the nearest few beyond."""
    inside = np.flatnonzero(distance <= 1)
    if len(inside) >= at_least:
        return inside
    order = np.argsort(distance, kind="stable")[:at_least]
    return order[np.isfinite(distance[order])]
