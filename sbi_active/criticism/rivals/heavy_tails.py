"""Student's t errors of unit deviation: their density, least squares and bounds."""

from __future__ import annotations

import numpy as np
from scipy.special import gammaln

from sbi_active.arrays import Array


def student(e: Array, df: float) -> Array:
    """Return log densities of t errors of unit standard deviation."""
    log_norm = gammaln(0.5 * (df + 1)) - gammaln(0.5 * df)
    log_norm -= 0.5 * np.log(np.pi * (df - 2))
    return log_norm - 0.5 * (df + 1) * np.log1p(e**2 / (df - 2))


def signed_deviance(e: Array, df: float) -> Array:
    r"""Return residuals whose squares are twice the log densities that t errors lose.

    .. math::
        \operatorname{sign}(e) \sqrt{2 \log t_\nu(0) - 2 \log t_\nu(e)}

    A sum of their squares is least where the likelihood is largest; it has several
    minima where the likelihood has several peaks.

    Args:
        e: Errors in standard deviations.
        df: Degrees of freedom.
    """
    return np.sign(e) * np.sqrt((df + 1) * np.log1p(e**2 / (df - 2)))


def from_deviance(residual: Array, df: float) -> Array:
    """Return the errors of :func:`signed_deviance`, shape (...)."""
    square = (df - 2) * np.expm1(residual**2 / (df + 1))
    return np.sign(residual) * np.sqrt(square)


def tangent(e: Array, df: float) -> tuple[Array, Array]:
    r"""Return the Gaussians that touch the density of t errors.

    .. math::
        \log t_\nu(x) \ge c - \frac{w^2 x^2}{2}, \qquad
        w^2 = \frac{\nu + 1}{\nu - 2 + e^2}

    for all x, with equality at e: whatever is integrated with them is a lower bound.

    Args:
        e: Errors at which they touch it, in standard deviations.
        df: Degrees of freedom, :math:`\nu`.

    Returns:
        w and c, each of the shape of e.

    References:
        Lange, Little & Taylor, Journal of the American Statistical Association 84
        (1989), for iteratively reweighted least squares of t errors.
    """
    weight = np.sqrt((df + 1) / (df - 2 + e**2))
    return weight, student(e, df) + 0.5 * (weight * e) ** 2


def deviance_slope(e: Array, df: float) -> Array:
    """Return the derivative of :func:`signed_deviance` by the error, shape (...)."""
    weight, _ = tangent(e, df)
    deviance = signed_deviance(e, df)
    # Of which the limit at zero is the weight.
    return np.divide(weight**2 * e, deviance, out=weight.copy(), where=deviance != 0)
