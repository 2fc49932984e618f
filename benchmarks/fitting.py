"""Least squares by SciPy, with derivatives by differences of rows at once.

Least squares of many problems at once: Levenberg and Marquardt, batched.

How much of an effect the parameters can take up: multi-start least squares.

Plain least squares of records with SciPy, given what the simulator lacks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sbi.utils import BoxUniform
from scipy.optimize import OptimizeResult, differential_evolution, least_squares
from torch import Tensor
from torch.distributions import HalfNormal, Uniform

from sbi_active.criticism import Context, Effect
from sbi_active.tasks.records import Pieces  # pyright: ignore

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


ITERATIONS = 12
DIFFERENCE = 1e-5  # of the scale of a parameter
ENOUGH = 1e-4  # relative fall of the cost below which a fit has ended


def batched_fits(
    predict: Callable[[Tensor], Tensor],
    target: Tensor,
    start: Tensor,
    *,
    low: Tensor,
    high: Tensor,
    scale: Tensor,
    weak: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return parameters and residuals, target minus prediction, of local fits.

    Args:
        predict: Parameters (n, d), float64, to predictions (n, m).
        target: In units of the noise, shape (b, m).
        start: Shape (b, d).
        low: Smallest parameters, shape (d,); -inf for none.
        high: Largest ones.
        scale: Of a step, shape (d,).
        weak: Standard deviation of a prior around zero, shape (d,); inf for none.

    Returns:
        Shapes (b, d) and (b, m).
    """
    num, dim = start.shape
    z = start.clamp(low, high)
    damping = torch.full((num,), 1e-3, dtype=torch.float64)
    residual = target - predict(z)

    def cost(residual: Tensor, z: Tensor) -> Tensor:
        total = residual.square().sum(1) + (z / weak).square().sum(1)
        return total.nan_to_num(nan=torch.inf)

    now = cost(residual, z)
    for _ in range(ITERATIONS):
        step = torch.where(z + DIFFERENCE * scale > high, -1.0, 1.0)
        step = step * DIFFERENCE * scale
        moved = (z[:, None] + torch.diag_embed(step)).reshape(num * dim, dim)
        x = (target[:, None] - predict(moved).reshape(num, dim, -1)).reshape(
            num, dim, -1
        )
        jacobian = (x - residual[:, None]) / step[..., None] * scale[:, None]
        jacobian = jacobian.nan_to_num(0.0, 0.0, 0.0)
        gram = jacobian @ jacobian.transpose(1, 2)
        slope = (jacobian @ residual[..., None])[..., 0] + z * scale / weak**2
        gram = gram + torch.diag((scale / weak) ** 2)
        # Parameters at an edge that push outward stay there.
        stuck = ((z <= low) & (slope > 0)) | ((z >= high) & (slope < 0))
        free = (~stuck).double()
        gram = gram * free[:, :, None] * free[:, None, :]
        diagonal = torch.diagonal(gram, dim1=1, dim2=2).clamp(min=1e-9)
        added = torch.diag_embed(damping[:, None] * diagonal + 1e-9)
        move = torch.linalg.solve(gram + added, -(slope * free))
        new = (z + move * scale).clamp(low, high)
        fresh = target - predict(new)
        after = cost(fresh, new)
        better = after < now
        fall = torch.where(better, (now - after) / now.clamp(min=1e-12), 0.0)
        z = torch.where(better[:, None], new, z)
        residual = torch.where(better[:, None], fresh, residual)
        now = torch.where(better, after, now)
        ended = better & (fall < ENOUGH)
        damping = torch.where(better, damping / 10, damping * 10).clamp(1e-9, 1e9)
        if bool((ended | (damping > 1e6) | (now < 1e-10)).all()):
            break
    return z, residual


STARTS = 8
GENERATIONS = 20  # of as many candidates as starts, where the simulator is rough
RUNS = 4  # there at most, as each finds an upper bound
NOTHING = 10.0  # sum of squares, below which no data tell, and no run must follow


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


LARGEST = 3.0  # strengths of effects, in deviations of their priors
NUM_UNIFORM = 200  # draws in a box, the best of which fits start from
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
) -> tuple[Array, float]:
    """Return the parameters of the smallest sum of squares, and half of that sum.

    Args:
        residual: Function of parameters, shape (n, d), to residuals, (n, m).
        low: Lower ends of the box, shape (d,).
        high: Upper ends.
        starts: Number of the best draws that local fits start from.
        evaluations: Largest number of evaluations of a fit, derivatives apart.
        difference: Step of derivatives, as a share of the box's width.
    """
    width = high - low

    def at(z: Array) -> Array:
        return residual(low + z * width)

    z = np.random.default_rng(0).uniform(size=(NUM_UNIFORM, len(low)))
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
) -> Fit:
    """Return the best of some local fits, from the best of 200 draws in a box.

    Args:
        predict: Function of parameters, shape (n, d), float64, to readings, (n, m).
        target: Readings, shape (m,).
        low: Lower ends of the box, d numbers.
        high: Upper ends.
        starts: Number of local fits.
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
    )
    return Fit(best, float(np.sqrt(2 * cost / len(target))))
