"""Simulated histories: every executed action at each of many parameter sets."""

from __future__ import annotations

from collections.abc import Callable
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

__all__ = ["Histories"]

Array = NDArray[Any]

MIN_PAIRS = 20  # replicates a noise estimate rests on


class Histories:
    """A growing pool of histories, some of them simulated twice.

    Args:
        simulator: ``simulator(theta, action)``.
        action: Executed actions, shape (t, action_dim).
        x: What was observed, stacked, shape (q,).
        coordinates: Of the prior.
        seed: Of the simulations.

    Attributes:
        z: Coordinates of the parameters, shape (n, d).
        x: Outcomes less the observed ones, shape (n, q).
    """

    def __init__(
        self,
        simulator: Callable[..., Any],
        action: Tensor,
        x: Array,
        coordinates: PriorCoordinates,
        seed: int,
    ) -> None:
        self.simulator, self.action, self.observed = simulator, action, x
        self.coordinates, self.seed = coordinates, seed
        self.z = np.zeros((0, coordinates.dim))
        self.x = np.zeros((0, x.size))
        self.first: list[int] = []
        self.second: list[int] = []

    def __len__(self) -> int:
        return len(self.z)

    def add(self, z: Array, num_replicates: int) -> None:
        """Simulate at z, shape (n, d), and again at the first few of them."""
        start = len(self.z)
        theta = self.coordinates.to_theta(np.concatenate([z, z[:num_replicates]]))
        t = len(self.action)
        rows = simulate(
            self.simulator,
            theta.repeat_interleave(t, 0),
            self.action.repeat(len(theta), 1),
            seed=derive_seed(self.seed, "histories", start),
        )
        x = rows.x.double().numpy().reshape(len(theta), -1)
        if x.shape[1] != self.observed.size:
            raise ValueError(
                f"expected simulated x of shape {tuple(rows.x.shape[1:])} a row, as "
                f"observed; got {self.observed.size // t} observed numbers a trial; do "
                "pass x (t, *x_shape) of the simulator's shape"
            )
        again = slice(len(z), None)
        if start == 0:
            require_noise(
                torch.from_numpy(x[:num_replicates]), torch.from_numpy(x[again])
            )
        # What was simulated is the float32 parameter.
        self.z = np.concatenate([self.z, self.coordinates.to_z(theta)])
        self.x = np.concatenate([self.x, x - self.observed])
        self.first += range(start, start + num_replicates)
        self.second += range(start + len(z), start + len(theta))

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
