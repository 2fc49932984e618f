"""Noise with heavy tails."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.seeding import row_uniforms
from sbi_active.simulation.noise.base import ScaleNoise, observed_terms


class StudentTNoise(ScaleNoise):
    r"""Independent Student-t noise of a given standard deviation.

    .. math::
        x = \mu + \sigma \sqrt{\tfrac{\nu - 2}{\nu}} \, t_\nu

    so that :math:`\sigma` is the standard deviation of x itself, not the scale of the
    t distribution, and :math:`\nu \to \infty` gives Gaussian noise of the same size.

    Args:
        sd: Standard deviation :math:`\sigma`, in the units of x; a number, or one a
            channel (the last axis of x).
        df: Degrees of freedom :math:`\nu > 2`, of all channels.
        posterior: Posterior of (sd, df), event shape (p,).

    Raises:
        ValueError: If a standard deviation is negative, or df is not above 2, where
            there is no standard deviation.

    References:
        Bailey, Mathematics of Computation 62 (1994), for the draws.

    Example:
        >>> noise = StudentTNoise(1.0, 4.0)
        >>> noise.log_prob(torch.zeros(1, 1), torch.zeros(1, 1)).item()
        -0.634...
    """

    def __init__(
        self,
        sd: float | Tensor,
        df: float | Tensor,
        *,
        posterior: Distribution | None = None,
    ) -> None:
        super().__init__(sd, shared={"df": df}, posterior=posterior)

    _is_gaussian = False

    def _check(self, parameters: Tensor) -> None:
        super()._check(parameters)
        df = parameters[..., -1]
        if not bool((df.isfinite() & (df > 2)).all()):
            raise ValueError(
                f"expected df > 2, below which there is no standard deviation; got "
                f"{df.tolist()}; use for example 4"
            )

    def _draw(self, seeds: Tensor | None, shape: torch.Size, rows: Tensor) -> Tensor:
        num = math.prod(shape[1:])
        if seeds is None:
            uniform = torch.rand(len(rows), 2 * num, dtype=torch.float64)
            uniform = uniform.clamp_min(1e-16)
        else:
            uniform = row_uniforms(seeds, 2 * num)
        df = rows[:, -1:]
        radius = (df * torch.expm1(-2 / df * uniform[:, :num].log())).sqrt()
        student = radius * torch.cos(2 * math.pi * uniform[:, num:])
        scale = self._spread(_scale(rows[:, :-1], df), shape)
        return scale * student.reshape(shape)

    def _log_density(self, residual: Tensor, rows: Tensor) -> Tensor:
        df = rows[:, -1:]
        scale = self._spread(_scale(rows[:, :-1], df), residual.shape)
        df = df.reshape(-1, *[1] * (residual.ndim - 1))
        density = log_student(residual / scale, df) - scale.log()
        return observed_terms(density, residual).flatten(1).sum(1)


def log_student(z: Tensor, df: Tensor) -> Tensor:
    """Return the log density of the standard t distribution."""
    constant = torch.lgamma(0.5 * (df + 1)) - torch.lgamma(0.5 * df)
    constant = constant - 0.5 * torch.log(math.pi * df)
    return constant - 0.5 * (df + 1) * torch.log1p(z**2 / df)


def _scale(sd: Tensor, df: Tensor) -> Tensor:
    return sd * ((df - 2) / df).sqrt()
