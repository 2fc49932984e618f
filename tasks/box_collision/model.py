"""The box collision as rows: parameters and speeds in, positions out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.tasks.box_collision.scene import (
    NOTHING_ELSE,
    LocalScene,
    Surroundings,
)

__all__ = [
    "ACTIONS",
    "CHANNEL_NAMES",
    "LEFT_TABLE",
    "PARAMETER_NAMES",
    "positions",
]

PARAMETER_NAMES = ("table_friction", "cube_friction", "cube_density")
CHANNEL_NAMES = ("x", "y", "z")  # m
ACTIONS = torch.arange(0.0, 20.5, 0.5)  # m/s
LEFT_TABLE = -1.0  # every coordinate in the paper's code of an outcome off the table
ROUNDING = 1e-6  # of theta in single precision


def positions(
    theta: Tensor,
    action: Tensor,
    *,
    context: LocalScene,
    lost_damping: Any = 0.0,
    viscosity: Any = 0.0,
    air_density: Any = 0.0,
    tilt: Any = 0.0,
    aim: Any = 0.0,
    center_of_mass: Any = 0.0,
    extra_pusher_friction: Any = 0.0,
    force: Any = 0.0,
    delay: Any = 0.0,
) -> Tensor:
    """Return where the cube is after 100 frames.

    Args:
        theta: Friction of the table, friction of the cube and density of the cube over
            1000 kg/m^3, shape (n, 3), within [0, 1].
        action: Speed of the pusher, m/s, shape (n, 1).
        context: The scene.
        lost_damping: As in :class:`Surroundings`, and so what follows; a number or one
            a row.
        viscosity: Pa s.
        air_density: kg/m^3.
        tilt: Degrees.
        aim: m.
        center_of_mass: m.
        extra_pusher_friction: Above .5.
        force: N.
        delay: s.

    Returns:
        Positions in m, shape (n, 3), float64; ``context.left_table`` throughout where
        the cube left the table.

    Raises:
        ValueError: If theta leaves [0, 1] or the shapes do not fit.
    """
    _check(theta, action)
    rows = theta.detach().cpu().double().clamp(0, 1).tolist()
    speeds = action.detach().cpu().double()[:, 0].tolist()
    surroundings = _surroundings(
        len(rows),
        {
            "lost_damping": lost_damping,
            "viscosity": viscosity,
            "air_density": air_density,
            "tilt": tilt,
            "aim": aim,
            "center_of_mass": center_of_mass,
            "extra_pusher_friction": extra_pusher_friction,
            "force": force,
            "delay": delay,
        },
    )
    run = context.scene.run
    x = np.full((len(rows), 3), context.left_table)
    for i, (parameters, speed) in enumerate(zip(rows, speeds, strict=True)):
        position = run(parameters, speed, surroundings[i])
        if position is not None:
            x[i] = position
    return torch.from_numpy(x)


def _surroundings(num: int, values: Mapping[str, Any]) -> list[Surroundings]:
    """Return one a row; most often all are the bare model."""
    given = {
        name: np.asarray(value, dtype=np.float64).reshape(-1)
        for name, value in values.items()
        if np.ndim(value) or value != getattr(NOTHING_ELSE, name)
    }
    if not given:
        return [NOTHING_ELSE] * num
    columns = {name: np.broadcast_to(column, num) for name, column in given.items()}
    return [
        Surroundings(**{name: float(column[i]) for name, column in columns.items()})
        for i in range(num)
    ]


def _check(theta: Tensor, action: Tensor) -> None:
    if theta.shape[1:] != (3,) or action.shape[1:] != (1,):
        raise ValueError(
            "expected theta (n, 3) and action (n, 1); got "
            f"{tuple(theta.shape)} and {tuple(action.shape)}; give one row a trial"
        )
    outside = (theta < -ROUNDING) | (theta > 1 + ROUNDING)
    bad = torch.nonzero(outside.any(1))[:, 0]
    if len(bad):
        row = int(bad[0])
        raise ValueError(
            f"expected theta within [0, 1], {', '.join(PARAMETER_NAMES)}; got "
            f"{theta[row].tolist()} in row {row}; draw from the task's prior"
        )
