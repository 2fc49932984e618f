r"""Predictive densities of rivals whose noise is known.

.. math::
    f_k(x) = \frac1n \sum_i \mathcal N\bigl(x \mid a m_i + (1 - a) \bar m_k,\;
    \operatorname{diag}(s_i^2) + h^2 C_k\bigr), \qquad a = \sqrt{1 - h^2}

with :math:`m_i` the outcomes without noise of posterior draws, :math:`s_i` the standard
deviations of the noise, :math:`\bar m_k, C_k` mean and covariance of the former. With h
= 0 it is the Monte Carlo average of the noise's density, which needs many draws where
the posterior predictive is wider than the noise; with h = 1 it is Gaussian.

References:
    West, Journal of the Royal Statistical Society B 55 (1993).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sbi_active.inference.sampling.weights import silverman
from sbi_active.information_gain.fits.class_density import LogDensities

#: Widths h, in those of Silverman's rule.
FACTORS = (0.25, 1.0)
#: Numbers of an outcome up to which each kernel has a covariance of its own.
MOST_NUMBERS = 12
#: Share of a Gaussian of all draws of a class, for what lies between the kernels.
TAIL = 0.1


def noise_members(
    mean: Tensor, sd: Tensor, label: Tensor, enough: Tensor
) -> list[LogDensities]:
    """Return densities of each class by kernels as narrow as the noise.

    Args:
        mean: Outcomes without noise, shape (n, q).
        sd: Standard deviation of the noise, shape (n, q).
        label: Class, shape (n,).
        enough: Whether a class has rows enough, shape (k,), bool; where one has not, or
            outcomes are long, there are no members.

    Returns:
        Functions of outcomes (m, q) that give log densities, shape (m, k).
    """
    usable = 0 < mean.shape[1] <= MOST_NUMBERS and bool(enough.all())
    if not usable or not bool((mean.isfinite() & (sd > 0)).all()):
        return []
    classes = [(mean[label == k], sd[label == k]) for k in range(len(enough))]
    members: list[LogDensities] = []
    for factor in FACTORS:
        mixtures = [_NoiseKernels(m, s, factor) for m, s in classes]
        members.append(
            lambda new, parts=mixtures: torch.stack([part(new) for part in parts], 1)
        )
    return members


class _NoiseKernels:
    """The density of one class, by means and deviations (n, q)."""

    def __init__(self, mean: Tensor, sd: Tensor, factor: float) -> None:
        n, q = mean.shape
        center = mean.mean(0)
        apart = mean - center
        covariance = apart.T @ apart / (n - 1)
        noise = sd.square()
        # directions in which the kernels would lie apart without smoothing
        unit = noise.mean(0).rsqrt()
        spread = torch.linalg.eigvalsh(unit[:, None] * covariance * unit)
        d = max(1, int((spread > 1).sum()))
        num = max(2, len(mean.unique(dim=0)))
        h = min(factor * silverman(num, d), 1.0)
        self.knots = center + math.sqrt(1 - h**2) * apart
        self.factors = torch.linalg.cholesky(noise.diag_embed() + h**2 * covariance)
        self.center = center
        self.wide = torch.linalg.cholesky(noise.mean(0).diag() + covariance)

    def __call__(self, x: Tensor) -> Tensor:
        """Return log densities, shape (m,), of outcomes, shape (m, q)."""
        kernels = _log_normal(x - self.knots[:, None], self.factors)
        log_density = kernels.logsumexp(0) - math.log(len(self.knots))
        tail = _log_normal((x - self.center)[None], self.wide[None])[0]
        return torch.logaddexp(log_density + math.log1p(-TAIL), tail + math.log(TAIL))


def _log_normal(apart: Tensor, factor: Tensor) -> Tensor:
    """Return log N(apart | 0, L L^T), shape (n, m), from (n, m, q) and (n, q, q)."""
    if factor.shape[-1] == 1:
        white, log_det = apart / factor, factor[:, 0, 0].log()
    else:
        white = torch.linalg.solve_triangular(factor, apart.mT, upper=False).mT
        log_det = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    constant = 0.5 * factor.shape[-1] * math.log(2 * math.pi)
    return -0.5 * white.square().sum(-1) - log_det[:, None] - constant
