r"""Sources in the plane, heard as one signal.

Sources at :math:`\theta_1, \ldots, \theta_K` emit signals that fall off with the square
of the distance. Their sum is measured at a place :math:`\xi` of our choice, on a log
scale,

.. math::
    x = \log \mu(\theta, \xi) + \varepsilon, \qquad
    \mu(\theta, \xi) = b + \sum_{k=1}^{K} \frac{1}{m + \|\theta_k - \xi\|^2}, \qquad
    \varepsilon \sim \mathcal N(0, \sigma^2),

with :math:`\theta_k \sim \mathcal N(0, I_2)`, :math:`b = .1, m = 10^{-4}, \sigma = .5`
and K = 2 (lengths and signals have no unit). The sources can be exchanged, so the
posterior is the same under that permutation, and a measurement far from both tells
hardly more than the sum.

References:
    Foster, Ivanova, Malik & Rainforth, ICML 2021, arXiv:2103.02438, section 6.1;
    Sheng & Hu, IEEE Transactions on Signal Processing 2005 (energy-based location).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = [
    "BACKGROUND",
    "NOISE_SD",
    "SOFTENING",
    "log_likelihood",
    "mean",
]

BACKGROUND = 0.1  # b
SOFTENING = 1e-4  # m
NOISE_SD = 0.5  # sigma


def mean(theta: Tensor, action: Tensor) -> Tensor:
    r"""Noise-free log signal :math:`\log \mu(\theta, \xi)`.

    Evaluated in float64 and differentiable in both arguments.

    Args:
        theta: Places of the sources one after another, shape (n, 2 K).
        action: Place of the measurement, shape (n, 2). Leading dimensions broadcast:
            (n, 1, 2 K) with (t, 2) gives (n, t, 1).

    Returns:
        Shape (n, 1), in the dtype of theta.

    Raises:
        ValueError: If the last dimensions are not even and 2.

    Example:
        >>> mean(torch.tensor([[1.0, 0.0, 0.0, 1.0]]), torch.zeros(1, 2))
        tensor([[0.7418]])
    """
    rows = theta.ndim >= 2 and action.ndim >= 2
    if not rows or theta.shape[-1] % 2 or action.shape[-1] != 2:
        raise ValueError(
            "expected theta (n, 2 K), two numbers a source, and action (n, 2); got "
            f"{tuple(theta.shape)} and {tuple(action.shape)}; give one row a trial"
        )
    place, xi = theta.double(), action.double()
    signal = torch.tensor(BACKGROUND, dtype=torch.float64)
    for k in range(0, theta.shape[-1], 2):
        square = (place[..., k] - xi[..., 0]) ** 2 + (
            place[..., k + 1] - xi[..., 1]
        ) ** 2
        signal = signal + 1 / (SOFTENING + square)
    return signal.log()[..., None].to(theta.dtype)


def log_likelihood(x: Tensor, theta: Tensor, action: Tensor) -> Tensor:
    r"""Exact :math:`\log p(x | \theta, \xi)`.

    Args:
        x: Shape (n, 1).
        theta: Shape (n, 2 K).
        action: Shape (n, 2). Leading dimensions broadcast, as in :func:`mean`: one
            history (t, 1) and (t, 2) with parameters (n, 1, 2 K) gives (n, t).

    Returns:
        Shape (n,), float64, nats.
    """
    apart = (x.double() - mean(theta.double(), action))[..., 0] / NOISE_SD
    return -0.5 * apart**2 - math.log(NOISE_SD * math.sqrt(2 * math.pi))
