r"""Coordinates in which the deviations of errors are about standard normal.

A channel may be right or wrong, two peaks of :math:`\log \sigma_c` between which no
chain goes, and which of them it is the other channels tell. Its coordinate is therefore
:math:`y_c = \Phi^{-1}(F_c(\sigma_c))` with :math:`F_c` about the marginal of its
posterior, on a grid. That is the mean, over Gibbs sweeps, of

.. math::
    p(\sigma_c | \sigma_{-c}, x_o) \propto p(\sigma_c) \sum_k
        w_k(\sigma_{-c})\, N(x_{o,c};\, m_{kc},\, v_{kc} + \sigma_c^2)

in which x and the components are summed out (Rao-Blackwell), with a share of what the
channel alone says to a power of .3, for the tails.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sbi_active.inference.sampling.weights import log_sum_exp
from sbi_active.pyro.error_models import ErrorModel
from sbi_active.pyro.predictive import Predictive

Array = NDArray[Any]

NUM_GRID = 1_000  # deviations
REACH, NUM_KNOTS = 6.0, 1_201  # of the coordinates
SHARE = 0.1  # of what a channel says alone


class Coordinates:
    """Log deviations as functions of coordinates that are about standard normal.

    Args:
        fit: Predictive of the channels that were seen.
        target: Outcome of these channels, shape (q,).
        error_model: Error model of the deviations.
        rng: Random generator of the Gibbs sweeps.
    """

    def __init__(
        self,
        fit: Predictive,
        target: Tensor,
        error_model: ErrorModel,
        rng: np.random.Generator,
        *,
        tempered: float = 0.3,
        lowest: float = 1e-4,
    ) -> None:
        highest = 10 * float(target.abs().max()) + 100
        self._low = float(np.log(lowest))
        self._step = (float(np.log(highest)) - self._low) / (NUM_GRID - 1)
        grid = self._low + self._step * torch.arange(NUM_GRID, dtype=target.dtype)
        log_prior = error_model.log_deviation(grid).numpy()
        log_alone = fit.log_alone(target, grid.exp()[:, None].expand(-1, len(target)))
        alone = tempered * log_alone.numpy().T
        alone = _normalized(alone, log_prior) + np.log(SHARE)
        gibbs = _swept(fit, target, log_prior, grid.numpy(), rng) + np.log(1 - SHARE)
        gain = np.logaddexp(alone, gibbs)  # density over the prior's, (q, grid)
        log_p = gain + log_prior
        p = np.exp(log_p - log_p.max(1, keepdims=True))
        area = 0.5 * (p[:, 1:] + p[:, :-1])
        cdf = np.concatenate([np.zeros((len(p), 1)), area.cumsum(1)], 1)
        cdf = cdf / cdf[:, -1:]
        y = torch.linspace(-REACH, REACH, NUM_KNOTS, dtype=target.dtype)
        levels = torch.special.ndtr(y).numpy()
        # Where nothing is likely the distribution is flat, and has no inverse.
        rising = np.arange(NUM_GRID) * 1e-15
        points = grid.numpy()
        knots = [np.interp(levels, row + rising, points) for row in cdf]
        self._knots = torch.from_numpy(np.stack(knots, 1))
        self._gain = torch.from_numpy(np.ascontiguousarray(gain.T))

    def __call__(self, y: Tensor) -> Tensor:
        """Return log deviations, (..., q) to (..., q)."""
        place = (y + REACH) * ((NUM_KNOTS - 1) / (2 * REACH))
        return _between(self._knots, place)

    def log_gain(self, log_sd: Tensor) -> Tensor:
        """Return the log density behind y over the prior's, (..., q) to (..., q)."""
        return _between(self._gain, (log_sd - self._low) / self._step)


def _between(table: Tensor, place: Tensor) -> Tensor:
    """Return a table's columns (n, q) at places between its rows, (..., q)."""
    place = place.clamp(0, len(table) - 1)
    low = place.detach().long().clamp_max(len(table) - 2)
    column = torch.arange(place.shape[-1])
    return torch.lerp(table[low, column], table[low + 1, column], place - low)


def _normalized(log_gain: Array, log_prior: Array) -> Array:
    """Return log densities over the prior's, each row of which has mass one."""
    total = [log_sum_exp(row + log_prior) for row in log_gain]
    return log_gain - np.array(total)[:, None]


def _swept(
    fit: Predictive,
    target: Tensor,
    log_prior: Array,
    grid: Array,
    rng: np.random.Generator,
    *,
    num_burnt: int = 20,
    num_sweeps: int = 80,
    smallest: float = 1e-12,
) -> Array:
    """Return each channel's log marginal over its prior by Gibbs sweeps, (q, grid)."""
    x, mean, cov = target.numpy(), fit.mean.numpy(), fit.cov.numpy()
    log_weight, variances = fit.log_weight.numpy(), np.exp(2 * grid)
    num, residual = len(x), x - mean  # (k, q)
    variance = np.exp(2 * grid[rng.integers(len(grid), size=num)])
    total = np.full((num, len(grid)), -np.inf)
    for sweep in range(num_burnt + num_sweeps):
        noisy = cov + np.diag(variance)
        precision = np.linalg.inv(noisy)
        log_volume = np.linalg.slogdet(noisy)[1]
        for c in rng.permutation(num):
            pulled = np.einsum("kij,kj->ki", precision, residual)
            own = precision[:, c, c]
            off, spread = pulled[:, c] / own, 1 / own
            # Density of all other channels: the whole without this one given them.
            square = (residual * pulled).sum(1) - off**2 * own
            rest = log_weight - 0.5 * (square + log_volume - np.log(spread))
            v = np.maximum(spread - variance[c], smallest)[:, None] + variances
            log_k = rest[:, None] - 0.5 * (off[:, None] ** 2 / v + np.log(v))
            gain = np.logaddexp.reduce(log_k, 0)
            log_p = gain + log_prior
            log_total = log_sum_exp(log_p)
            if sweep >= num_burnt:
                total[c] = np.logaddexp(total[c], gain - log_total)
            p = np.exp(log_p - log_total)
            drawn = variances[rng.choice(len(grid), p=p / p.sum())]
            change = drawn - variance[c]
            grown = 1 + change * own
            column = precision[:, :, c]
            precision = precision - (change / grown)[:, None, None] * (
                column[:, :, None] * column[:, None, :]
            )
            log_volume = log_volume + np.log(grown)
            variance[c] = drawn
    return total - np.log(num_sweeps)
