"""Independent Gaussian noise."""

from __future__ import annotations

from torch import Tensor

from sbi_active.simulation.noise.base import ScaleNoise
from sbi_active.simulation.noise.posterior import NoisePosterior


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
        >>> import torch
        >>> noise.log_prob(torch.zeros(1, 1), torch.zeros(1, 1)).item()
        -1.612...
    """

    def __init__(
        self, sd: float | Tensor, *, posterior: NoisePosterior | None = None
    ) -> None:
        super().__init__(sd, posterior=posterior)
