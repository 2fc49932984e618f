"""Independent Gaussian noise."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.simulation.noise.base import (
    ScaleNoise,
    observed_terms,
    standard_normals,
)
from sbi_active.simulation.noise.posterior import (
    InverseChiSquare,
    NoisePosterior,
    log_student_evidence,
)

LOG_2PI = math.log(2 * math.pi)


class GaussianNoise(ScaleNoise):
    r"""Independent Gaussian noise, :math:`x \sim N(\mu, \sigma^2)`.

    With the posterior of :func:`.estimate_noise`, a row is a
    multivariate Student-t, exactly: numbers that share a standard deviation have one
    draw of it in common.

    Args:
        sd: Standard deviation :math:`\sigma`, in the units of x; a number, or one a
            channel (the last axis of x).
        posterior: Posterior of the standard deviations, event shape (channels,).

    Raises:
        ValueError: If a standard deviation is negative or not finite.

    Example:
        >>> noise = GaussianNoise(2.0)
        >>> noise.log_prob(torch.zeros(1, 1), torch.zeros(1, 1)).item()
        -1.612...
    """

    def __init__(
        self, sd: float | Tensor, *, posterior: Distribution | None = None
    ) -> None:
        super().__init__(sd, posterior=posterior)

    def _draw(
        self,
        seeds: Tensor | None,
        shape: torch.Size,
        parameters: Tensor,
        times: Tensor | None,
    ) -> Tensor:
        return self._spread(parameters, shape) * standard_normals(seeds, shape)

    def _log_density(
        self, residual: Tensor, parameters: Tensor, times: Tensor | None
    ) -> Tensor:
        sd = self._spread(parameters, residual.shape)
        density = -0.5 * (residual / sd) ** 2 - torch.log(sd) - 0.5 * LOG_2PI
        return observed_terms(density, residual).flatten(1).sum(1)

    def _marginal(self, residual: Tensor, times: Tensor | None) -> Tensor:
        posterior = self.posterior
        if not isinstance(posterior, NoisePosterior):
            return super()._marginal(residual, times)
        assert isinstance(posterior.sd, InverseChiSquare)
        square = self._by_channel(observed_terms(residual.square(), residual))
        count = self._by_channel((~residual.isnan()).double())
        return log_student_evidence(square, count, posterior.sd, cell=0).sum(1)
