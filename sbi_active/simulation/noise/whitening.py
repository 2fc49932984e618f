"""Numbers in deviations of their noise."""

from __future__ import annotations

from torch import Tensor

from sbi_active.simulation.noise.autocorrelated import AutocorrelatedNoise, chained
from sbi_active.simulation.noise.base import NoiseModel, declared_sds
from sbi_active.simulation.noise.gaussian import GaussianNoise


def is_known_gaussian(noise: NoiseModel | None) -> bool:
    """Return whether noise is Gaussian and nothing of it is unknown."""
    gaussian = isinstance(noise, GaussianNoise | AutocorrelatedNoise)
    return gaussian and noise.posterior is None


def whitened(noise: NoiseModel, value: Tensor) -> Tensor:
    r"""Return :math:`C^{-1/2} v` for the noise's covariance C, shape (n, \*x_shape).

    Unknown parameters are at the values that the noise declares for them, and heavy
    tails count by their standard deviation.

    Args:
        noise: Declared.
        value: v, in the units of x, shape (n, \*x_shape); NaN where not observed.

    Returns:
        Float64; NaN where not observed.
    """
    v = value.double()
    if isinstance(noise, AutocorrelatedNoise):
        tau = noise.parameters[-1].double().expand(len(v))
        change, variance = chained(v, tau, noise.times)
        v = (change / variance.sqrt()).reshape(v.shape)
    sds = declared_sds(noise)
    return v / (sds if len(sds) > 1 else sds[0])
