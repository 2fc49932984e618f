"""Plain least squares of the servo pendulum, given what the simulator lacks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

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
DRAWS, STARTS, EVALUATIONS = 200, 4, 30
DIFFERENCE = 1e-5  # of a parameter's range


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

    def value(z: Array) -> Array:
        return residual(z[None], trials).ravel()

    def jacobian(z: Array) -> Array:
        step = np.where(z + DIFFERENCE > 1, -DIFFERENCE, DIFFERENCE)
        every = residual(np.concatenate([z[None], z + np.diag(step)]), trials)
        flat = every.reshape(len(z) + 1, -1)
        return ((flat[1:] - flat[0]) / step[:, None]).T

    z = np.random.default_rng(seed).uniform(size=(DRAWS, len(low)))
    cost = (residual(z, trials) ** 2).sum((1, 2))
    found = [
        least_squares(
            value,
            start,
            jacobian,  # type: ignore[arg-type]  # SciPy's stub has the string alone
            bounds=(0, 1),
            max_nfev=EVALUATIONS,
        )
        for start in z[np.argsort(cost)[:STARTS]]
    ]
    best = min(found, key=lambda f: f.cost).x
    return Fit(low + best * width, residual(best[None], range(num))[0])
