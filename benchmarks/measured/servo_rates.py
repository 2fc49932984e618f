"""How many samples a second of the servo count, given what is left in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.measured.servo_least_squares import FRICTIONS
from sbi_active.tasks.servo_pendulum import ServoPendulumTask  # pyright: ignore
from sbi_active.tasks.servo_pendulum.model import angles  # pyright: ignore

__all__ = ["RATES", "by_rate"]

Array = NDArray[Any]

RATES = (50.0, 25.0, 12.5, 5.0)  # samples a second
NUM_TIMES = 60


def by_rate(
    fine: ServoPendulumTask,
    trials: Sequence[int],
    fits: Mapping[str, Sequence[float]],
) -> list[dict[str, Any]]:
    """Return the largest likelihood of autocorrelated errors, and what they leave.

    Args:
        fine: The recordings at the largest of the rates.
        trials: Rows that are compared.
        fits: Parameters of each model, by the names of its effects.

    Returns:
        One row a rate and model: log likelihood, correlation time, and the correlation
        of neighboring innovations, which is zero where the errors are as assumed.
    """
    r, rows = fine.recordings, []
    for name, parameters in fits.items():
        values = np.repeat(np.asarray(parameters)[None], len(trials), axis=0)
        names = [n for n in name.split(" + ") if n in FRICTIONS]
        friction = {FRICTIONS[n][0]: values[:, 5 + j] for j, n in enumerate(names)}
        x = angles(
            values[:, :5],
            r.kp,
            r.goal,
            r.enabled,
            r.start,
            np.array([*trials]),
            every=r.every,
            **friction,
        )
        residual = r.angle[[*trials]] - x
        for rate in RATES:
            every = round(RATES[0] / rate)
            found = _likeliest(residual[:, every - 1 :: every], 1 / rate)
            rows.append({"model": name, "rate": rate, **found})
    return rows


def _likeliest(residual: Array, step: float) -> dict[str, float]:
    """Return the maximum over size and correlation time."""
    best: dict[str, float] = {"log_likelihood": -np.inf}
    for tau in np.geomspace(0.02, 12.0, NUM_TIMES):
        rho = np.exp(-step / tau)
        e = residual.copy()
        e[:, 1:] = (residual[:, 1:] - rho * residual[:, :-1]) / np.sqrt(1 - rho**2)
        num, pairs = e.size, e[:, 1:].size
        log_p = -0.5 * num * (np.log(2 * np.pi * (e**2).mean()) + 1)
        log_p -= 0.5 * pairs * np.log1p(-(rho**2))
        if log_p > best["log_likelihood"]:
            inner = e[:, 1:]
            neighbors = (inner[:, 1:] * inner[:, :-1]).mean() / (inner**2).mean()
            best = {
                "log_likelihood": float(log_p),
                "correlation_time": float(tau),
                "innovations": float(neighbors),
            }
    return best
