"""Plain least squares of records with SciPy, given what the simulator lacks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor
from torch.distributions import HalfNormal

from sbi_active.criticism import Effect

__all__ = ["Fit", "effect_bounds", "fit_record"]

Array = NDArray[np.float64]

DRAWS, STARTS, EVALUATIONS = 200, 6, 60
DIFFERENCE = 1e-6  # of a parameter's range
LARGEST = 6.0  # strengths of effects, in deviations of their priors
LOST = 1e3  # reading in place of one that is not finite


@dataclass(frozen=True)
class Fit:
    """A fit.

    Attributes:
        parameters: Shape (d,).
        rmse: Over the readings that were fitted.
    """

    parameters: Array
    rmse: float


def effect_bounds(effects: Sequence[Effect]) -> tuple[list[float], list[float]]:
    """Return the smallest and largest strengths, six prior deviations either way.

    Args:
        effects: With normal or half-normal priors.
    """
    low: list[float] = []
    high: list[float] = []
    for effect in effects:
        prior: Any = getattr(effect.prior, "base_dist", effect.prior)
        edge = (LARGEST * prior.scale.double()).tolist()
        positive = isinstance(prior, HalfNormal)
        low += [0.0 if positive else -value for value in edge]
        high += edge
    return low, high


def fit_record(
    predict: Callable[[Tensor], Tensor],
    target: Tensor,
    low: Sequence[float],
    high: Sequence[float],
    *,
    seed: int = 0,
) -> Fit:
    """Return the best of six local fits, from the best of 200 draws in a box.

    Args:
        predict: Parameters (n, d), float64, to readings (n, m).
        target: Readings, shape (m,).
        low: Of the box, d numbers.
        high: Likewise.
        seed: Of the draws.
    """
    least, width = np.array(low), np.array(high) - np.array(low)

    def residual(z: Array) -> Array:
        x = predict(torch.from_numpy(least + z * width))
        return (x - target).nan_to_num(LOST, LOST, -LOST).numpy()

    def value(z: Array) -> Array:
        return residual(z[None])[0]

    def jacobian(z: Array) -> Array:
        step = np.where(z + DIFFERENCE > 1, -DIFFERENCE, DIFFERENCE)
        every = residual(np.concatenate([z[None], z + np.diag(step)]))
        return ((every[1:] - every[0]) / step[:, None]).T

    z = np.random.default_rng(seed).uniform(size=(DRAWS, len(least)))
    cost = (residual(z) ** 2).sum(1)
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
    best = min(found, key=lambda f: f.cost)
    return Fit(least + best.x * width, float(np.sqrt(2 * best.cost / len(target))))
