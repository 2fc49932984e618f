"""Noise with heavy tails."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.distributions import StudentT
from typing_extensions import override

from sbi_active.expected import require
from sbi_active.seeding import row_uniforms
from sbi_active.simulation.noise.base import ScaleNoise


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

    def __init__(self, sd: float | Tensor, df: float | Tensor) -> None:
        super().__init__(sd, df=df)
        self.is_known_gaussian, df = False, float(self.parameters[-1])
        expected = "df > 2, below which there is no standard deviation"
        require(df > 2, expected, df, "use for example 4")

    @override
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
        return self._scale * student.reshape(shape)

    @override
    def _log_density(self, residual: Tensor) -> Tensor:
        df, scale = self.parameters[-1], self._scale.to(residual)
        return StudentT(df, 0.0, scale, validate_args=False).log_prob(residual)

    @property
    def _scale(self) -> Tensor:
        """Scale of the t distribution, of the shape of sd."""
        df = self.parameters[-1]
        return self.sd * ((df - 2) / df).sqrt()
