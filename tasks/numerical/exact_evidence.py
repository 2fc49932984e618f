r"""Evidence of the numerical model, by one closed form and one quadrature.

.. math::
    x = g(\theta_1)\, e^{3 - \xi} + \theta_2\, \xi + \varepsilon, \qquad
    \varepsilon \sim \mathcal N(0, 1), \quad \theta \sim \mathcal U[-5, 5]^2.

With :math:`r_k = x_k - g(\theta_1) e^{3 - \xi_k}`, the joint density of data and
parameters is a Gaussian in :math:`\theta_2`, cut off by the box:

.. math::
    p(\mathcal D, \theta) &= h(\theta_1)\,
        e^{-\frac12 (\theta_2 - m)^2 / s^2}, \qquad
    s^{-2} = \sum_k \xi_k^2, \quad m = s^2 \sum_k \xi_k r_k, \\
    h(\theta_1) &= p(\theta)\, (2 \pi)^{-t / 2}
        e^{-\frac12 \left(\sum_k r_k^2 - m^2 / s^2\right)}, \\
    p(\mathcal D, \theta_1) &= h(\theta_1)\, s \sqrt{2 \pi}\,
        \left[\Phi\!\left(\tfrac{5 - m}{s}\right)
            - \Phi\!\left(\tfrac{-5 - m}{s}\right)\right].

The last line is log-concave in :math:`g`, so it has one peak in :math:`\theta_1`
wherever :math:`g` is monotone: zooming in on the peak cannot miss it, however narrow.
Where :math:`g` is even, :math:`\theta_1` is folded onto [0, 5].
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

Array = NDArray[np.float64]

BOUND = 5.0  # theta_1, theta_2 and the action all lie in [-BOUND, BOUND]
REACH = 9.0  # standard deviations beyond which a Gaussian is dropped
LOG_SQRT_2PI = 0.5 * np.log(2 * np.pi)
FLAT = 1e-12  # precision of theta_2 where it is unidentified: log p changes by 1e-11


@dataclass(frozen=True, kw_only=True)
class Response:
    """A curve g, monotone on [-5, 5], or on [0, 5] where it is even."""

    curve: Callable[[Array], Array]
    steepest: float
    even: bool = False

    @property
    def low(self) -> float:
        """Lower end of the folded range of theta_1."""
        return 0.0 if self.even else -BOUND


RESPONSES = {
    "linear": Response(curve=lambda t: t, steepest=1.0),
    "sinh": Response(
        curve=lambda t: 5 * np.sinh(t / 2.5) / np.sinh(2), steepest=2 / np.tanh(2)
    ),
    "square": Response(curve=lambda t: t**2 / 2.5 - 5, steepest=4.0, even=True),
}


def profile(
    response: Response, theta_1: Array, action: Array, x: Array
) -> tuple[Array, Array, float]:
    r"""The joint density as a Gaussian in :math:`\theta_2`.

    Args:
        response: The curve g.
        theta_1: Shape (n, k).
        action: :math:`\xi`, shape (t,).
        x: Data sets, shape (n, t) or (1, t).

    Returns:
        :math:`m` and :math:`\log h`, both (n, k), and :math:`s`.
    """
    g = response.curve(theta_1)[..., None]
    residual = x[:, None, :] - g * np.exp(3 - action)
    precision = (action**2).sum() + FLAT
    mean = residual @ action / precision
    log_prior = -np.log(BOUND - response.low) - np.log(2 * BOUND)
    misfit = (residual**2).sum(-1) - precision * mean**2
    log_peak = log_prior - action.size * LOG_SQRT_2PI - 0.5 * misfit
    return mean, log_peak, float(precision**-0.5)


def integrate(mean: Array, log_peak: Array, sd: float) -> Array:
    r"""Log integral over :math:`\theta_2` in the box, of what `profile` returns."""
    log_mass = log_normal_mass((-BOUND - mean) / sd, (BOUND - mean) / sd)
    return log_peak + np.log(sd) + LOG_SQRT_2PI + log_mass


def log_evidence(
    response: Response, action: Array, x: Array
) -> tuple[Array, Array, Array]:
    r""":math:`\log p(\mathcal D)` of n data sets.

    Args:
        response: The curve g.
        action: :math:`\xi`, shape (t,).
        x: Data sets, shape (n, t).

    Returns:
        Log evidence in nats, and the lower and upper end of the range of
        :math:`\theta_1` that carries it, each (n,).
    """
    row = np.arange(len(x))
    low, high = np.full(len(x), response.low), np.full(len(x), BOUND)
    for _ in range(8):  # the range shrinks up to 16-fold each time
        grid = np.linspace(low, high, 33, axis=1)
        log_marginal = integrate(*profile(response, grid, action, x))
        fall = log_marginal.max(1, keepdims=True) - log_marginal
        kept = fall < 0.5 * REACH**2
        first, last = kept.argmax(1), 32 - kept[:, ::-1].argmax(1)
        low = grid[row, np.maximum(first - 1, 0)]
        high = grid[row, np.minimum(last + 1, 32)]
    theta_1, weight = legendre_nodes(low, high, 16)
    log_marginal = integrate(*profile(response, theta_1, action, x))
    peak = log_marginal.max(1)
    evidence = peak + np.log((weight * np.exp(log_marginal - peak[:, None])).sum(1))
    return evidence, low, high


def log_normal_mass(a: Array, b: Array) -> Array:
    r""":math:`\log [\Phi(b) - \Phi(a)]` for a < b, precise in either tail."""
    a, b = np.where(a > 0, -b, a), np.where(a > 0, -a, b)
    log_a, log_b = log_ndtr(a), log_ndtr(b)
    with np.errstate(divide="ignore"):
        return log_b + np.log(-np.expm1(log_a - log_b))


def legendre_nodes(
    low: Array | float, high: Array | float, num_panels: int
) -> tuple[Array, Array]:
    """Gauss-Legendre nodes and weights, 16 on each of equal panels of [low, high].

    Args:
        low: Lower ends, a number or shape (n,).
        high: Upper ends, alike.
        num_panels: Number of panels.

    Returns:
        Nodes and weights, both (num_nodes,) or (n, num_nodes).
    """
    node, weight = np.polynomial.legendre.leggauss(16)
    low, high = np.asarray(low)[..., None, None], np.asarray(high)[..., None, None]
    half = 0.5 * (high - low) / num_panels
    nodes = low + half * (2 * np.arange(num_panels)[:, None] + 1 + node)
    weights = np.broadcast_to(half * weight, nodes.shape)
    shape = (*nodes.shape[:-2], -1)
    return nodes.reshape(shape), weights.reshape(shape)
