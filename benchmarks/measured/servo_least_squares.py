"""Plain least squares of the servo pendulum, given what the simulator lacks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.measured.box_search import Search
from sbi_active.tasks.servo_pendulum import ServoPendulumTask  # pyright: ignore
from sbi_active.tasks.servo_pendulum.model import (  # pyright: ignore
    PRIOR_HIGH,
    PRIOR_LOW,
    angles,
)

__all__ = ["FRICTIONS", "Fit", "fit"]

Array = NDArray[Any]

#: Keyword of the simulator and largest strength, by the name of the effect.
FRICTIONS = {
    "Coulomb": ("coulomb", 0.3),
    "load-dependent": ("load", 1.0),
    "torque-dependent": ("torque", 1.0),
    "viscous": ("viscous", 0.1),
}
SEARCH = Search(draws=200, starts=4, evaluations=30, difference=1e-5)


@dataclass(frozen=True)
class Fit:
    """A fit to some recorded trials.

    Attributes:
        parameters: theta and the strengths.
        residual: Recorded minus predicted angles of all trials, rad, shape (t, k).
    """

    parameters: Array
    residual: Array

    def rmse(self, trials: Sequence[int]) -> float:
        """Return the root mean square over some trials, rad."""
        return float(np.sqrt((self.residual[[*trials]] ** 2).mean()))


def fit(
    task: ServoPendulumTask,
    trials: Sequence[int],
    names: Sequence[str] = (),
    *,
    seed: int = 0,
) -> Fit:
    """Return the least-squares fit of the simulator with some effects.

    Within the prior's box, from the best four of 200 draws.

    Args:
        task: Holds the recordings.
        trials: Rows that are fitted.
        names: Of the effects.
        seed: Of the draws.
    """
    r, num = task.recordings, len(task.recordings)
    low = np.array([*PRIOR_LOW, *[0.0 for _ in names]])
    width = np.array([*PRIOR_HIGH, *[FRICTIONS[n][1] for n in names]]) - low

    def residual(z: Array, rows: Sequence[int]) -> Array:
        """Return residuals, shape (n, trials, k), of z in the unit box, (n, d)."""
        each = np.repeat(low + z * width, len(rows), axis=0)
        friction = {FRICTIONS[n][0]: each[:, 5 + j] for j, n in enumerate(names)}
        x = angles(
            each[:, :5],
            r.kp,
            r.goal,
            r.enabled,
            r.start,
            np.tile([*rows], len(z)),
            every=r.every,
            **friction,
        )
        return r.angle[[*rows]] - x.reshape(len(z), len(rows), -1)

    def flat(z: Array) -> Array:
        return residual(z, trials).reshape(len(z), -1)

    z, _ = SEARCH.best(flat, len(low), seed)
    return Fit(low + z * width, residual(z[None], range(num))[0])
