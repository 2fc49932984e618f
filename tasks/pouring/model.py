"""Pours as rows: parameters and actions in, poses or depth images out."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.tasks.pouring.materials import (
    EFFECT_NAMES,
    MOST_PARTICLES,
    NOTHING_ELSE,
    Particles,
    Surface,
    Surroundings,
)
from sbi_active.tasks.pouring.raster import NUM_PIXELS, height_image
from sbi_active.tasks.pouring.scene import pour

__all__ = ["ACTION_NAMES", "ACTION_UNITS", "PARAMETER_NAMES", "Pours", "images_of"]

PARAMETER_NAMES = ("friction", "rolling_friction", "restitution")
#: As :class:`Pours` reads them, in this order behind those of a particle.
REAL_PARAMETER_NAMES = (
    "ground_friction",
    "ground_dynamic_friction",
    "ground_restitution",
    "friction",
    "rolling_friction",
    "restitution",
    "linear_damping",
    "angular_damping",
)
ACTION_NAMES = ("height", "position", "rate")
ACTION_UNITS = ("cm", "cm", "rad/s")
ROUNDING = 1e-6  # of theta in single precision
LOWEST = 12.0  # cm: the bucket turns about its middle, half its diagonal above ground


class Pours:
    """The pour as a function of rows, for any material.

    Args:
        particles: What is poured.
        parameter_names: Of theta: three of the particles, or eight with the ground.

    Raises:
        ValueError: If there are too many particles, or they do not fit the bucket.
    """

    def __init__(
        self,
        particles: Particles,
        parameter_names: tuple[str, ...] = PARAMETER_NAMES,
    ) -> None:
        if not 1 <= len(particles) <= MOST_PARTICLES:
            raise ValueError(
                f"expected 1 to {MOST_PARTICLES} particles; got {len(particles)}; pour "
                "fewer"
            )
        particles.lattice()
        self.particles, self.parameter_names = particles, parameter_names

    def poses(
        self, theta: Tensor, action: Tensor, seeds: Tensor, **effects: Any
    ) -> np.ndarray:
        """Return where the particles lie, each row in a new world.

        Args:
            theta: Shape (n, 3) or (n, 8), within [0, 1].
            action: Height and position of the bucket, cm, and its rate, rad/s, shape
                (n, 3).
            seeds: Of the rows, shape (n,).
            effects: As in :class:`.Surroundings`, a number or one a row.

        Returns:
            Positions, m, and quaternions (x, y, z, w), shape (n, particles, 7),
            float32.

        Raises:
            ValueError: If theta leaves [0, 1], the bucket would touch the ground or the
                shapes do not fit.
        """
        self._check(theta, action)
        rows = theta.detach().cpu().double().clamp(0, 1).tolist()
        actions = action.detach().cpu().double().tolist()
        around = _surroundings(len(rows), effects)
        found = np.empty((len(rows), len(self.particles), 7), np.float32)
        for i, row in enumerate(rows):
            particle, ground, own = self._split(row, around[i])
            found[i] = pour(
                self.particles,
                particle,
                actions[i],
                ground=ground,
                around=own,
                seed=int(seeds[i]) & (2**63 - 1),
            )
        return found

    def images(
        self,
        theta: Tensor,
        action: Tensor,
        *,
        seeds: Tensor,
        linear_damping: Any = 0.0,
        angular_damping: Any = 0.0,
        tilt: Any = 0.0,
        bucket_y: Any = 0.0,
        bucket_height: Any = 0.0,
        cohesion: Any = 0.0,
        lag: Any = 0.0,
    ) -> Tensor:
        """Return depth images, shape (n, 22500), see :func:`images_of`.

        Args:
            theta: As for :meth:`poses`.
            action: As for :meth:`poses`.
            seeds: Of the rows, shape (n,).
            linear_damping: As in :class:`.Surroundings`, and so what follows; a number
                or one a row.
            angular_damping: 1/s.
            tilt: Degrees.
            bucket_y: m.
            bucket_height: m.
            cohesion: In units of theta's rolling friction.
            lag: s.
        """
        poses = self.poses(
            theta,
            action,
            seeds,
            linear_damping=linear_damping,
            angular_damping=angular_damping,
            tilt=tilt,
            bucket_y=bucket_y,
            bucket_height=bucket_height,
            cohesion=cohesion,
            lag=lag,
        )
        return images_of(poses, self.particles)

    def _split(
        self, row: list[float], around: Surroundings
    ) -> tuple[list[float], Surface, Surroundings]:
        if len(row) == len(PARAMETER_NAMES):
            return row, Surface(), around
        resting, moving, bounce, *particle, linear, angular = row
        ground = Surface(resting, bounce, moving)
        return particle, ground, _more_damped(around, linear, angular)

    def _check(self, theta: Tensor, action: Tensor) -> None:
        names = self.parameter_names
        if theta.shape[1:] != (len(names),) or action.shape[1:] != (3,):
            raise ValueError(
                f"expected theta (n, {len(names)}) and action (n, 3); got "
                f"{tuple(theta.shape)} and {tuple(action.shape)}; give one row a trial"
            )
        inside = (theta >= -ROUNDING) & (theta <= 1 + ROUNDING)  # NaN is not
        bad = torch.nonzero(~inside.all(1))[:, 0]
        if len(bad):
            row = int(bad[0])
            raise ValueError(
                f"expected theta within [0, 1], {', '.join(names)}; got "
                f"{theta[row].tolist()} in row {row}; draw from the task's prior"
            )
        possible = (action[:, 0] >= LOWEST) & (action[:, 2] > 0)
        possible &= action.isfinite().all(1)
        bad = torch.nonzero(~possible)[:, 0]
        if len(bad):
            row = int(bad[0])
            raise ValueError(
                f"expected a height of {LOWEST:g} cm or more and a rate above 0 rad/s; "
                f"got {action[row].tolist()} in row {row}; raise the bucket, or turn it"
            )


def images_of(poses: np.ndarray, particles: Particles) -> Tensor:
    """Return what the camera sees of stored poses: heights above ground.

    Args:
        poses: Shape (n, particles, 7).
        particles: Whose poses they are.

    Returns:
        Heights of 150 x 150 pixels of 2 x 2 mm about the origin, row by row along x,
        in mm; 0 on the ground. Shape (n, 22500), float32.
    """
    x = np.empty((len(poses), NUM_PIXELS**2), np.float32)
    for i, own in enumerate(poses):
        x[i] = height_image(own, particles.half, particles.shape).reshape(-1)
    return torch.from_numpy(x)


def _more_damped(around: Surroundings, linear: float, angular: float) -> Surroundings:
    own = {name: getattr(around, name) for name in EFFECT_NAMES}
    own["linear_damping"] += linear
    own["angular_damping"] += angular
    return Surroundings(**own)


def _surroundings(num: int, values: dict[str, Any]) -> list[Surroundings]:
    """Return one a row; most often all are the bare model."""
    given = {k: v for k, v in values.items() if np.ndim(v) or v != 0}
    if not given:
        return [NOTHING_ELSE] * num
    columns = {
        name: np.broadcast_to(np.asarray(value, float).reshape(-1), num)
        for name, value in given.items()
    }
    return [
        Surroundings(**{name: float(column[i]) for name, column in columns.items()})
        for i in range(num)
    ]
