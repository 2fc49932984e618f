"""A few numbers of a long outcome that matter for a target."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

MAX_NUMBERS = 6  # of an outcome that need no reduction
RIDGE = 0.01  # share of the total variance, that a direction is penalized by
LIMIT = 8.0  # standard deviations beyond which a number is cut off


@dataclass(frozen=True)
class Reduction:
    r"""Standardized outcomes, or the directions of them that predict the target.

    Long outcomes are projected on the slopes of ridge regressions of the target's
    numbers on x, and on the leading principal components, six in all.

    Attributes:
        center: Center of the outcomes, shape (q,).
        scale: Scale of the outcomes, shape (q,).
        direction: Directions, shape (q, r).
    """

    center: Tensor
    scale: Tensor
    direction: Tensor

    @staticmethod
    def fit(x: Tensor, target: Tensor) -> Reduction:
        """Fit to outcomes (n, q) and numbers to predict (n, t)."""
        n, q = x.shape
        center, scale = x.mean(0), x.std(0)
        scale = torch.where(scale > 1e-30, scale, 1.0)
        z = (x - center) / scale
        if q <= MAX_NUMBERS:
            return Reduction(center, scale, torch.eye(q, dtype=x.dtype))
        moment = z.T @ z / n + RIDGE * torch.eye(q)
        slope = torch.linalg.solve(moment, z.T @ (target - target.mean(0)) / n)
        left, value, _ = torch.linalg.svd(slope, full_matrices=False)
        slope = left[:, value > 1e-9 * value.amax()][:, : MAX_NUMBERS - 2]
        leading = torch.linalg.eigh(moment).eigenvectors.flip(1)[:, :MAX_NUMBERS]
        direction = torch.linalg.qr(torch.cat([slope, leading], 1)).Q[:, :MAX_NUMBERS]
        return Reduction(center, scale, direction / (z @ direction).std(0))

    def standard(self, x: Tensor) -> Tensor:
        """Return all numbers standardized, shape (n, q)."""
        return ((x - self.center) / self.scale).clamp(-LIMIT, LIMIT)

    def __call__(self, x: Tensor) -> Tensor:
        """Return the reduced outcomes, shape (n, r)."""
        return (self.standard(x) @ self.direction).clamp(-LIMIT, LIMIT)
