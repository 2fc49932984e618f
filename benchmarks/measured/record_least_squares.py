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

from benchmarks.measured.box_search import Search
from sbi_active.criticism import Context, Effect
from sbi_active.tasks.records import Pieces  # pyright: ignore

__all__ = ["Fit", "effect_bounds", "fit_record", "run_rows"]

Array = NDArray[np.float64]

SEARCH = Search(draws=200, starts=6, evaluations=60, difference=1e-6)
LARGEST = 3.0  # strengths of effects, in deviations of their priors
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
        pieces: t of them.
        effects: Whose strengths they are, all of them keyword arguments.
        dim: Of theta.
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
    """Return the smallest and largest strengths.

    Args:
        effects: With normal or half-normal priors, three deviations of them, or uniform
            ones.
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

    best, cost = SEARCH.best(residual, len(least), seed)
    return Fit(least + best * width, float(np.sqrt(2 * cost / len(target))))
