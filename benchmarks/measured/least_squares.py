"""Plain least squares of records with SciPy, given what the simulator lacks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.distributions import HalfNormal, Uniform

from benchmarks.fitting import local_fit
from sbi_active.criticism import Context, Effect
from sbi_active.tasks.records import Pieces  # pyright: ignore

Array = NDArray[np.float64]
LARGEST = 3.0  # strengths of effects, in deviations of their priors
LOST = 1e3  # reading in place of one that is not finite


@dataclass(frozen=True)
class Fit:
    """A fit.

    Attributes:
        parameters: Parameters and strengths, shape (d,).
        rmse: Root mean square error over the readings that were fitted.
    """

    parameters: Array
    rmse: float

    def row(self, errors: dict[str, float]) -> dict[str, Any]:
        """Return it as plain figures, with its errors by held-out record."""
        own = {"parameters": self.parameters.tolist(), "fitted": self.rmse}
        return own | {"held": errors}


def best_in_box(
    residual: Callable[[Array], Array],
    low: Array,
    high: Array,
    *,
    starts: int,
    evaluations: int,
    difference: float,
    draws: int = 200,
    seed: int = 0,
) -> tuple[Array, float]:
    """Return the parameters of the smallest sum of squares, and half of that sum.

    Args:
        residual: Function of parameters, shape (n, d), to residuals, (n, m).
        low: Lower ends of the box, shape (d,).
        high: Upper ends.
        starts: Number of the best draws that local fits start from.
        evaluations: Largest number of evaluations of a fit, derivatives apart.
        difference: Step of derivatives, as a share of the box's width.
        draws: Number of uniform draws in the box.
        seed: Seed of the draws.
    """
    width = high - low

    def at(z: Array) -> Array:
        return residual(low + z * width)

    z = np.random.default_rng(seed).uniform(size=(draws, len(low)))
    order = np.argsort((at(z) ** 2).sum(1))[:starts]
    limits: dict[str, Any] = {"low": 0.0, "high": 1.0, "difference": difference}
    found = [
        local_fit(at, start, evaluations=evaluations, **limits) for start in z[order]
    ]
    best = min(found, key=lambda fit: fit.cost)
    return low + best.x * width, best.cost


def run_rows(
    simulate: Callable[..., Tensor],
    parameters: Tensor,
    pieces: Pieces,
    effects: Sequence[Effect],
    dim: int,
    **starts: Tensor,
) -> Tensor:
    """Return predictions of pieces, shape (n, t, k).

    Args:
        simulate: The simulator.
        parameters: Theta and strengths, shape (n, dim + d), float64.
        pieces: The t pieces.
        effects: Effects whose strengths they are, all of them keyword arguments.
        dim: Number of parameters of the bare simulator.
        starts: Further keyword arguments, shape (n t,).
    """
    sizes = [dim, *[effect.phi_dim for effect in effects]]
    each = parameters.double().repeat_interleave(len(pieces), 0)
    theta, *strengths = each.split(sizes, 1)
    rows = pieces.rows(len(parameters))
    context = Context(torch.arange(len(each)).double())
    keywords: dict[str, Any] = {}
    for effect, phi in zip(effects, strengths, strict=True):
        keywords = effect.apply(keywords, phi, rows["action"], context)
    x = simulate(theta, **rows, **starts, **keywords)
    return x.reshape(len(parameters), len(pieces), -1)


def effect_bounds(effects: Sequence[Effect]) -> tuple[list[float], list[float]]:
    """Return the smallest and largest strengths of effects.

    Uniform priors bound them, others by three of their deviations.
    """
    low: list[float] = []
    high: list[float] = []
    for effect in effects:
        prior: Any = getattr(effect.prior, "base_dist", effect.prior)
        if isinstance(prior, Uniform):
            low += prior.low.tolist()
            high += prior.high.tolist()
            continue
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
    starts: int = 6,
    seed: int = 0,
) -> Fit:
    """Return the best of some local fits, from the best of 200 draws in a box.

    Args:
        predict: Function of parameters, shape (n, d), float64, to readings, (n, m).
        target: Readings, shape (m,).
        low: Lower ends of the box, d numbers.
        high: Upper ends.
        starts: Number of local fits.
        seed: Seed of the draws.
    """

    def residual(rows: Array) -> Array:
        left = predict(torch.from_numpy(rows)) - target
        return left.nan_to_num(LOST, LOST, -LOST).numpy()

    best, cost = best_in_box(
        residual,
        np.array(low),
        np.array(high),
        starts=starts,
        evaluations=60,
        difference=1e-6,
        seed=seed,
    )
    return Fit(best, float(np.sqrt(2 * cost / len(target))))
