"""Rules for the width of kernels, in deviations of the draws."""

from __future__ import annotations


def scott(num: float, dim: int) -> float:
    """Return Scott's width, :math:`n^{-1 / (d + 4)}`, of n draws that count.

    References:
        Scott, *Multivariate Density Estimation*, 1992.
    """
    return num ** (-1 / (dim + 4))


def silverman(num: float, dim: int) -> float:
    r"""Return Silverman's width, :math:`(4 / ((d + 2)\, n))^{1 / (d + 4)}`.

    It has the least mean integrated squared error where the draws are normal.

    References:
        Silverman, *Density Estimation for Statistics and Data Analysis*, 1986.
    """
    return (4 / ((dim + 2) * num)) ** (1 / (dim + 4))
