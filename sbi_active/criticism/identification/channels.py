r"""Errors of an unknown shape and size in every channel, drawn for all of them at once.

.. math::
    r_c(u) \sim \mathcal N(0, v_c\, C_{h_c})

Of several channels there are too many combinations to sum over. Given u, channels are
independent, so that errors are drawn by what the residuals at some likely u say of each
channel,

.. math::
    q(h, v) = \frac1P \sum_p \prod_c p(h_c, v_c \mid r_c(u_p)),

and a linear model is summed over the draws, with the weights :math:`p(h, v) / q(h, v)`,
as it is over a grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from sbi_active.arrays import Array
from sbi_active.criticism.linear.left_out import bounded
from sbi_active.criticism.linear.model import LinearModel
from sbi_active.criticism.linear.processes import Grams, Processes
from sbi_active.criticism.rivals.error_models import drawn
from sbi_active.inference.sampling.weights import log_sum_exp

TINY = 1e-300  # keeps logarithms finite


@dataclass(frozen=True)
class ChannelErrors:
    """What rows say of the errors of each channel.

    Attributes:
        processes: Hypotheses of the errors, white noise first, of size one.
        grams: Gram matrices of a linear model's rows, by channel.
        known: Deviation of the white part of each channel, shape (c,); None if it is
            unknown, and as likely on any scale.
        white: Prior probability that a channel's errors are white, one half for want of
            anything better.
    """

    processes: Processes
    grams: Grams
    known: Array | None
    white: float = 0.5

    @cached_property
    def _log_prior(self) -> Array:
        """Log prior probability of each hypothesis, shape (h,)."""
        num = len(self.processes)
        rest = np.full(num - 1, (1 - self.white) / max(num - 1, 1))
        return np.log(np.append(self.white, rest))

    def _said(self, u: Array) -> tuple[Array, Array]:
        """Return log probabilities of hypotheses, and squares, both (p, c, h).

        Args:
            u: Places, counted from where the rows are, shape (p, d).
        """
        one = np.concatenate([np.ones((len(u), 1)), -u], 1)
        square = np.einsum("pi,hcij,pj->pch", one, self.grams.gram, one, optimize=True)
        square, count = np.maximum(square, TINY), self.grams.count[:, None]
        if self.known is None:  # with the variance summed out, p(v) = 1 / v
            log_p = -0.5 * count * np.log(square)
        else:
            every = self._every
            log_p = -0.5 * (square / every + count * np.log(every))
        log_p = log_p + self._log_prior - 0.5 * self.grams.log_det.T
        return log_p - log_sum_exp(log_p, axis=2)[..., None], square

    @property
    def _every(self) -> Array:
        """Variance of each hypothesis where the white part is known, shape (c, h)."""
        assert self.known is not None
        return self.known[:, None] ** 2 / self.processes.white

    def likeliest(self, u: Array) -> tuple[NDArray[np.intp], Array]:
        """Return the likeliest hypothesis and variance of each channel, (c,), at u."""
        log_p, square = self._said(u[None])
        shape, channel = log_p[0].argmax(1), np.arange(log_p.shape[1])
        if self.known is not None:
            return shape, self._every[channel, shape]
        return shape, square[0, channel, shape] / self.grams.count

    def places(
        self,
        model: LinearModel,
        free: NDArray[np.bool_],
        num: int,
        rng: np.random.Generator,
        *,
        rounds: int = 6,
    ) -> Array:
        """Return draws of the coordinates where errors are likeliest, (num, d).

        Args:
            model: Linear model of the rows, which counts from where they are.
            free: Coordinates that are not zero, shape (d,).
            num: Number of draws.
            rng: Source of the draws.
            rounds: Times that errors and coordinates are found given the other. A place
                that is not final costs draws of the errors, and no more.
        """
        u, cov, weight = np.zeros(len(free)), np.zeros((len(free),) * 2), model.sd**-2
        at, ends = np.ix_(free, free), (model.low[free], model.high[free])
        for _ in range(rounds):
            shape, variance = self.likeliest(u)
            gram = self._gram(shape[None], variance[None])[0]
            precision = (gram[1:, 1:] + np.diag(weight))[at]
            right = (gram[1:, 0] + model.center * weight)[free]
            u[free] = bounded(precision[None], right[None], *ends)[0]
            cov[at] = np.linalg.inv(precision)
        return model.draws(u, cov, num, rng)

    def drawn(
        self, u: Array, num: int, rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """Return draws of all channels' errors by the residuals at some places.

        Args:
            u: Places, shape (p, d).
            num: Number of draws.
            rng: Source of the draws.

        Returns:
            Gram matrices of all rows in the metric of each draw, (num, k, k); log prior
            densities, with the constants of the likelihood, over the density of the
            draws, (num,).
        """
        log_p, square = self._said(u)
        channel, half = np.arange(log_p.shape[1]), 0.5 * self.grams.count
        place = np.arange(num) % len(u)
        (shape,) = drawn(log_p[place].reshape(-1, log_p.shape[2]), rng)
        shape = shape.reshape(num, -1)
        log_q = log_p[:, channel, shape]
        if self.known is None:
            own = 0.5 * square[:, channel, shape]
            variance = own[place, np.arange(num)] / rng.gamma(half, size=shape.shape)
            rate = own / variance
            log_q = log_q + half * np.log(rate) - rate - gammaln(half)
        else:
            variance = self._every[channel, shape]
        log_p = self._log_prior[shape] - half * np.log(variance)
        log_p = log_p - 0.5 * self.grams.log_det[shape, channel]
        log_q = log_sum_exp(log_q.sum(2), axis=0) - np.log(len(u))
        return self._gram(shape, variance), log_p.sum(1) - log_q

    def _gram(self, shape: NDArray[np.intp], variance: Array) -> Array:
        """Return the Gram matrix of all rows given the errors, shape (n, k, k)."""
        own = self.grams.gram[shape, np.arange(shape.shape[1])]
        return (own / variance[..., None, None]).sum(1)
