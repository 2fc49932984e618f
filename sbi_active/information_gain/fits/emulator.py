"""A smooth interpolation of noise-free outcomes over the parameters."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

LENGTHS = (0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 6.0)  # in standard deviations of the belief
REFINED = (0.7, 1.0, 1.4)  # of the best isotropic length, in the metric of slopes
NUGGET = 1e-6  # of the variance: rounding leaves kernels of near rows singular
FEW = 300  # rows that choose the metric
NEGLIGIBLE = 1e-4  # error, below which metrics tie, lest rounding choose among them
BLOCK = 2**18  # kernel entries at once, to stay in the cache


@dataclass(frozen=True)
class MeanEmulator:
    r"""Kriging with the Matern kernel of smoothness 5/2, one metric for all outcomes.

    .. math::
        \hat f(\theta) = B^\top (1, z) + k(z)^\top K^{-1} (F - Z B), \qquad
        z = W^\top (\theta - \mu), \quad
        k = (1 + s + s^2 / 3)\, e^{-s}, \; s = \sqrt 5\, |z - z_j|.

    All candidates share their parameters, hence one factor of K serves them all. W is
    chosen by leave-one-out errors, first isotropic in whitened theta, then along the
    average slopes of the outcomes.

    Attributes:
        center: :math:`\mu`, shape (d,).
        transform: W, shape (d, d).
        knots: z of the simulations, shape (n, d).
        trend: B, shape (1 + d, q).
        weight: :math:`K^{-1} (F - Z B)`, shape (n, q).
        error: Leave-one-out errors of the rows that chose the metric, shape (m, q).

    References:
        Rasmussen & Williams, Gaussian Processes for Machine Learning, 2006, section
        2.7 and Eq. 5.12.
    """

    center: Tensor
    transform: Tensor
    knots: Tensor
    trend: Tensor
    weight: Tensor
    error: Tensor

    @staticmethod
    def fit(theta: Tensor, f: Tensor) -> MeanEmulator:
        """Interpolate outcomes (n, q) over parameters (n, d), in negligible units."""
        d = theta.shape[1]
        center, white = whitening(theta)

        def choose(w: Tensor, lengths: tuple[float, ...]) -> tuple[Tensor, Tensor]:
            z, few = (theta[:FEW] - center) @ w, f[:FEW]
            errors = [_leave_one_out(z / length, few) for length in lengths]
            best = min(range(len(lengths)), key=lambda i: _score(errors[i]))
            return w / lengths[best], errors[best]

        transform, error = choose(white, LENGTHS)
        first = MeanEmulator._solve(theta[:FEW], f[:FEW], center, transform, error)
        slope = first.slope(first.knots) / (f.std(0) + 1)[:, None]
        metric = torch.einsum("nqi,nqj->ij", slope, slope)
        metric = metric / metric.diagonal().mean().clamp_min(1e-30)
        bent = transform @ torch.linalg.cholesky(metric + 0.01 * torch.eye(d))
        bent, bent_error = choose(bent, REFINED)
        if _score(bent_error) < _score(error):
            transform, error = bent, bent_error
        return MeanEmulator._solve(theta, f, center, transform, error)

    @staticmethod
    def _solve(
        theta: Tensor, f: Tensor, center: Tensor, transform: Tensor, error: Tensor
    ) -> MeanEmulator:
        z = (theta - center) @ transform
        trend = torch.linalg.lstsq(linear(z), f).solution
        factor = torch.linalg.cholesky(kernel(z, z) + NUGGET * torch.eye(len(z)))
        weight = torch.cholesky_solve(f - linear(z) @ trend, factor)
        return MeanEmulator(center, transform, z, trend, weight, error)

    def coordinates(self, theta: Tensor) -> Tensor:
        """Return z of parameters, shape (n, d)."""
        return (theta - self.center) @ self.transform

    def parameters(self, z: Tensor) -> Tensor:
        """Return parameters of z, shape (n, d)."""
        return z @ torch.linalg.inv(self.transform) + self.center

    def __call__(self, z: Tensor, columns: slice = slice(None)) -> Tensor:
        """Return some of the outcomes at coordinates, shape (n, d) -> (n, q)."""
        trend, weight = self.trend[:, columns], self.weight[:, columns].contiguous()
        blocks = z.split(max(1, BLOCK // len(self.knots)))
        return torch.cat(
            [linear(b) @ trend + kernel(b, self.knots) @ weight for b in blocks]
        )

    def slope(self, z: Tensor) -> Tensor:
        r"""Return the derivatives at coordinates, (n, d) -> (n, q, d).

        .. math::
            \partial k / \partial z = -\tfrac53 (1 + s) e^{-s} (z - z_j)
        """
        s = 5**0.5 * torch.cdist(z, self.knots)
        radial = -5 / 3 * (1 + s) * (-s).exp()
        columns = [
            (radial * (z[:, None, i] - self.knots[:, i])) @ self.weight
            + self.trend[1 + i]
            for i in range(z.shape[1])
        ]
        return torch.stack(columns, -1)


def whitening(theta: Tensor) -> tuple[Tensor, Tensor]:
    """Return the center of parameters and what whitens them, shapes (d,) and (d, d)."""
    d = theta.shape[1]
    size = theta.abs().amax(0).clamp_min(1e-30)
    spread = torch.maximum(theta.std(0), 1e-9 * size)  # of draws that are all alike
    covariance = torch.cov((theta / spread).T).reshape(d, d) + 1e-8 * torch.eye(d)
    factor = torch.linalg.cholesky(covariance)
    return theta.mean(0), torch.linalg.inv(factor).T / spread[:, None]


def linear(z: Tensor) -> Tensor:
    """Return the features (1, z), shape (n, 1 + d)."""
    return torch.nn.functional.pad(z, (1, 0), value=1.0)


def kernel(z: Tensor, knots: Tensor) -> Tensor:
    """Return the Matern kernel of smoothness 5/2, shape (n, k)."""
    s = torch.cdist(z, knots).mul_(5**0.5)
    return s.div(3).add_(1).mul_(s).add_(1).mul_(s.neg_().exp_())


def _leave_one_out(z: Tensor, f: Tensor) -> Tensor:
    inverse = torch.linalg.inv(kernel(z, z) + NUGGET * torch.eye(len(z)))
    trend = linear(z) @ torch.linalg.lstsq(linear(z), f).solution
    return inverse @ (f - trend) / inverse.diagonal()[:, None]


def _score(error: Tensor) -> float:
    return max(float(error.square().log1p().mean()), NEGLIGIBLE**2)
