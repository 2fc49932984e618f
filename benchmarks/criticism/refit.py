"""How much of an effect the parameters can take up: multi-start least squares."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from sbi.utils import BoxUniform
from scipy.optimize import OptimizeResult, differential_evolution
from torch import Tensor

from benchmarks.fitting import local_fit

STARTS = 8
GENERATIONS = 20  # of as many candidates as starts, where the simulator is rough
RUNS = 4  # there at most, as each finds an upper bound
NOTHING = 10.0  # sum of squares, below which no data tell, and no run must follow
DIFFERENCE = 1e-5  # of a parameter's range


def residual_sum_of_squares(
    residual: Callable[[Tensor], Tensor],
    starts: Tensor,
    *,
    prior: BoxUniform,
    is_rough: bool = False,
) -> float:
    """Return the smallest sum of squares, arguments as for :func:`local_fits`.

    Args:
        residual: As there.
        starts: As there.
        prior: As there.
        is_rough: Whether derivatives lead nowhere: differential evolution then searches
            theta's box and the range of the starts' strengths, up to four times.
    """
    if not is_rough:
        return min(2 * fit.cost for fit in local_fits(residual, starts, prior=prior))
    low, high = starts.amin(0), starts.amax(0)
    edges = torch.stack(_edges(prior)).double()
    low[: edges.shape[1]], high[: edges.shape[1]] = edges
    best = np.inf
    for run in range(RUNS):
        found = differential_evolution(
            lambda z: residual(torch.from_numpy(z.T.copy())).square().sum(1).numpy(),
            np.stack([low.numpy(), high.numpy()], 1),
            init=starts.numpy(),  # pyright: ignore[reportArgumentType]
            maxiter=GENERATIONS,
            tol=0.0,
            polish=False,
            vectorized=True,
            updating="deferred",
            rng=run,
        )
        best = min(best, float(found.fun))
        if best < NOTHING:
            break
    return best


def local_fits(
    residual: Callable[[Tensor], Tensor], starts: Tensor, *, prior: BoxUniform
) -> list[OptimizeResult]:
    """Return least-squares fits within the prior's box, one a start.

    Args:
        residual: Parameters (n, d), float64, to residuals (n, m).
        starts: Candidates to start from, shape (k, d); the best eight are used. Columns
            beyond theta are strengths of effects, and unbounded.
        prior: Of theta, the first columns.

    Returns:
        SciPy's results: ``x``, ``cost`` (half of the sum of squares) and ``jac``.
    """
    low, high = (edge.double() for edge in _edges(prior))
    dim = len(low)
    spread = starts.std(0).clamp(min=1e-6).numpy()
    lower = np.full(starts.shape[1], -np.inf)
    upper = np.full(starts.shape[1], np.inf)
    lower[:dim], upper[:dim] = low.numpy(), high.numpy()
    cost = residual(starts).square().sum(-1)
    return [
        local_fit(
            lambda rows: residual(torch.from_numpy(rows)).numpy(),
            np.clip(starts[i].numpy(), lower + 1e-9, upper - 1e-9),
            low=lower,
            high=upper,
            scale=spread,
            difference=DIFFERENCE,
            evaluations=60,
        )
        for i in torch.argsort(cost)[:STARTS].tolist()
    ]


def _edges(prior: BoxUniform) -> tuple[Tensor, Tensor]:
    return prior.base_dist.low, prior.base_dist.high
