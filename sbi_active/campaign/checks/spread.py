"""Gaussian spread of rows of numbers, few or many, some of them not measured."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

#: Shares of the diagonal among which the leave-one-out likelihood chooses.
SHARES = torch.logspace(-10, 0, 21, dtype=torch.float64)
FLOOR = 1e-10  # of the largest variance, for numbers that never vary


@dataclass(frozen=True)
class Spread:
    r"""Mean and covariance of rows, the latter shrunk towards its diagonal.

    .. math::
        C = (1 - \lambda) \hat C + \lambda \operatorname{diag} \hat C,

    with the :math:`\lambda` of the largest leave-one-out Gaussian likelihood, so that C
    can be used with more numbers than rows. Missing numbers count as the mean. No
    result depends on the order of the rows.

    Attributes:
        mean: Means, shape (q,).
        scale: Standard deviations, shape (q,).
        share: :math:`\lambda`.
        z: Standardized rows, zero if not measured, shape (n, q).
        distance: Squared Mahalanobis distance of each row, shape (n,).

    References:
        Hoffbeck & Landgrebe, IEEE PAMI 1996 (leave-one-out shrinkage).
    """

    mean: Tensor
    scale: Tensor
    share: float
    z: Tensor
    distance: Tensor

    @staticmethod
    def of(rows: Tensor) -> Spread:
        """Return the spread of rows (n, q), float64, NaN where not measured."""
        present = rows.isfinite()
        count = present.sum(0).clamp_min(1)
        mean = rows.nansum(0) / count
        gap = torch.where(present, rows - mean, 0.0)
        variance = gap.square().sum(0) / count
        floor = FLOOR * variance.max().clamp_min(1e-30)
        scale = (variance + floor).sqrt()
        z = gap / scale
        share, distance = _shrunk(z)
        return Spread(mean, scale, share, z, distance)

    def root(self) -> Tensor:
        """Return the lower Cholesky factor of C, shape (q, q)."""
        covariance = (1 - self.share) * self.z.T @ self.z / len(self.z)
        diagonal = torch.full_like(self.scale, self._least).diag()
        return self.scale[:, None] * torch.linalg.cholesky(covariance + diagonal)

    def log_normal(self, x: Tensor) -> float:
        r"""Return the log density of N(mean, C) at x (q,), without its constant.

        With more numbers than rows from their products,
        :math:`(\lambda I + Z^\top Z)^{-1} = \lambda^{-1}
        (I - Z^\top (\lambda I + Z Z^\top)^{-1} Z)`.
        """
        n, q = self.z.shape
        off, scale = x - self.mean, self.scale.log().sum()
        if q <= n:
            root = self.root()
            z = torch.linalg.solve_triangular(root, off[:, None], upper=False)
            return float(-0.5 * z.square().sum() - root.diagonal().log().sum())
        rows, off = self.z * ((1 - self.share) / n) ** 0.5, off / self.scale
        inner = rows @ rows.T + self._least * torch.eye(n, dtype=rows.dtype)
        root, along = torch.linalg.cholesky(inner), rows @ off
        part = torch.linalg.solve_triangular(root, along[:, None], upper=False)
        square = (off.square().sum() - part.square().sum()) / self._least
        volume = root.diagonal().log().sum() + 0.5 * (q - n) * math.log(self._least)
        return float(-0.5 * square - volume - scale)

    @property
    def _least(self) -> float:
        return max(self.share, FLOOR)


def _shrunk(z: Tensor) -> tuple[float, Tensor]:
    r"""Return the share of the diagonal and each row's squared distance with it.

    Without row i the sample covariance about the same mean is

    .. math:: \hat C_{-i} = (n \hat C - z_i z_i^\top) / (n - 1).

    With :math:`G = (1 - \lambda) n / (n - 1) \hat C + \lambda I`,
    :math:`d_i = z_i^\top G^{-1} z_i` and :math:`b = (1 - \lambda) / (n - 1)`, the
    shrunk covariance without row i has the determinant :math:`|G| (1 - b d_i)`, and row
    i the squared distance :math:`d_i / (1 - b d_i)` by it.
    """
    n, q = z.shape
    if q <= n:
        value, vector = torch.linalg.eigh(z.T @ z / n)
        square = (z @ vector).square()
    else:  # the same from the smaller matrix of products of rows
        value, vector = torch.linalg.eigh(z @ z.T / n)
        square = n * vector.square() * value.clamp_min(0)
    value = value.clamp_min(0)[:, None]
    others = max(n - 1, 1)
    left = (1 - SHARES) * value * (n / others) + SHARES
    distance = square @ (1 / left)
    log_det = left.log().sum(0) + (q - len(value)) * SHARES.log()
    kept = (1 - (1 - SHARES) / others * distance).clamp_min(1e-12)
    loss = log_det + (kept.log() + distance / kept).mean(0)
    share = SHARES[int(loss.argmin())]
    return float(share), square @ (1 / ((1 - share) * value[:, 0] + share))
