"""Plain least squares of a falling ball, given what the simulator lacks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from sbi_active.tasks.ball_drops.data import Drop  # pyright: ignore
from sbi_active.tasks.ball_drops.model import GRAVITY  # pyright: ignore

__all__ = ["KINDS", "forecast_error", "second_drop_error"]

Array = NDArray[Any]

#: Bounds of (h0, t0, strength), and starts of t0 and the strength.
STRENGTHS = {
    "gravity alone": (),
    "free gravity": (6.0, 9.0),
    "linear drag": (0.05, 0.3),
    "quadratic drag": (0.003, 0.02),
}
KINDS = (*STRENGTHS,)
STARTS = (-0.3, 0.0, 0.3)  # s
LOW, HIGH = (-np.inf, -2.0, 1e-6), (np.inf, 1.0, 20.0)


def second_drop_error(fitted: Drop, tested: Drop, kind: str) -> float:
    """Return the RMSE of a drop that only lends its release to the model.

    The strength comes from the other drop, the release height and time from this one.

    Args:
        fitted: Drop that the strength is fitted to.
        tested: Drop that is predicted.
        kind: One of ``KINDS``.
    """
    strength = _fit(fitted, kind)[2:]
    h0, t0 = _fit(tested, kind, strength=strength)[:2]
    return _rms(_height(kind, tested.times, h0, t0, strength) - tested.heights)


def forecast_error(fitted: Drop, tested: Drop, kind: str, *, until: float) -> float:
    """Return the RMSE of the rest of a drop, its release fitted to the beginning.

    Args:
        fitted: Drop that the strength is fitted to.
        tested: Drop that is predicted.
        kind: One of ``KINDS``.
        until: End of the beginning, s.
    """
    strength = _fit(fitted, kind)[2:]
    early = tested.times <= until
    h0, t0 = _fit(tested, kind, strength=strength, among=early)[:2]
    error = _height(kind, tested.times, h0, t0, strength) - tested.heights
    return _rms(error[~early])


def _fit(
    drop: Drop, kind: str, *, strength: Array | None = None, among: Any = slice(None)
) -> Array:
    """Return (h0, t0) or (h0, t0, strength) of the smallest sum of squares."""
    times, heights = drop.times[among], drop.heights[among]
    free = strength is None and bool(STRENGTHS[kind])

    def residual(z: Array) -> Array:
        own = z[2:] if free or strength is None else strength
        return _height(kind, times, z[0], z[1], own) - heights

    num = 3 if free else 2
    fits = [
        least_squares(
            residual, [heights[0], t0, c][:num], bounds=(LOW[:num], HIGH[:num])
        )
        for t0 in STARTS
        for c in (STRENGTHS[kind] if free else (0.0,))
    ]
    return min(fits, key=lambda fit: fit.cost).x


def _height(kind: str, times: Array, h0: float, t0: float, strength: Array) -> Array:
    s = np.maximum(times - t0, 0.0)
    ways: dict[str, Callable[[], Array]] = {
        "gravity alone": lambda: 0.5 * GRAVITY * s**2,
        "free gravity": lambda: 0.5 * strength[0] * s**2,
        "linear drag": lambda: (
            GRAVITY / strength[0] * (s + np.expm1(-strength[0] * s) / strength[0])
        ),
        "quadratic drag": lambda: (
            np.log(np.cosh(np.sqrt(GRAVITY * strength[0]) * s)) / strength[0]
        ),
    }
    return h0 - ways[kind]()


def _rms(error: Array) -> float:
    return float(np.sqrt(np.mean(error**2)))
