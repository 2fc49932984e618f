"""Least squares of many problems at once: Levenberg and Marquardt, batched."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

ITERATIONS = 12
DIFFERENCE = 1e-5  # of the scale of a parameter
ENOUGH = 1e-4  # relative fall of the cost below which a fit has ended


def least_squares(
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
