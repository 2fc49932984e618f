"""Least squares by SciPy, with derivatives by differences of rows at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares

Array = NDArray[np.float64]


def local_fit(
    residual: Callable[[Array], Array],
    start: Array,
    *,
    low: Array | float,
    high: Array | float,
    scale: Array | float = 1.0,
    difference: float,
    evaluations: int,
) -> OptimizeResult:
    """Return SciPy's result of a fit within a box.

    Args:
        residual: Function of parameters, shape (n, d), to residuals, (n, m).
        start: Parameters to start from, shape (d,).
        low: Lower ends of the box, shape (d,) or one number.
        high: Upper ends.
        scale: Scale of each parameter.
        difference: Step of derivatives, in these scales; backwards at the upper end.
        evaluations: Largest number of evaluations, derivatives apart.
    """
    step: Any = difference * np.broadcast_to(scale, start.shape)

    def jacobian(z: Array) -> Array:
        signed = np.where(z + step > high, -step, step)
        every = residual(np.concatenate([z[None], z + np.diag(signed)]))
        return ((every[1:] - every[0]) / signed[:, None]).T

    return least_squares(
        lambda z: residual(z[None])[0],
        start,
        jacobian,  # type: ignore[arg-type]  # SciPy's stub has the string alone
        bounds=(low, high),
        x_scale=scale,
        max_nfev=evaluations,
    )
