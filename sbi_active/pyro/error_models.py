r"""Error models :math:`p(x_o | x)`.

All numbers are in deviations of the predictive, channel by channel. Indicators of
misspecification are discrete and summed out; their probabilities are recovered from the
draws. Every error here is normal given its own deviation :math:`\sigma`, and
``log_deviation`` is the density of :math:`\log \sigma`, over which NUTS runs.

References:
    Ward, Cannon, Beaumont, Fasiolo & Schmon, "Robust neural posterior estimation and
    statistical model criticism", NeurIPS 2022.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import pyro.distributions as dist
import torch
from torch import Tensor
from torch.distributions import Distribution


class ErrorModel(Protocol):
    """The error of an outcome, in deviations of the predictive."""

    def log_deviation(self, log_sd: Tensor) -> Tensor:
        """Return the log density of the log deviation of a channel's error, (n,)."""
        ...

    def misspecified(self, x: Tensor, x_o: Tensor) -> Tensor:
        """Return the probability of misspecification a channel, (n, q) -> (n, q)."""
        ...


class _RightOrWrong(ABC):
    """A channel is right, or wrong with some probability."""

    probability: float
    spike: float

    @abstractmethod
    def _wrong(self, x: Tensor, log_sd: Tensor) -> tuple[Distribution, Tensor]:
        """Return a wrong channel around x, and log densities of its log deviation."""

    def _parts(self, x: Tensor, x_o: Tensor) -> Tensor:
        """Return log densities of an outcome that is right and wrong, (2, n, q)."""
        right = dist.Normal(x, self.spike).log_prob(x_o) + np.log(1 - self.probability)
        wrong = self._wrong(x, x)[0].log_prob(x_o) + np.log(self.probability)
        return torch.stack([right, wrong])

    def misspecified(self, x: Tensor, x_o: Tensor) -> Tensor:
        """Return probabilities given denoised outcomes (n, q), shape (n, q)."""
        return self._parts(x, x_o).softmax(0)[1]

    def log_deviation(self, log_sd: Tensor) -> Tensor:
        """Return the log density of the log deviation of a channel's error, (n,)."""
        right = _known(self.spike, log_sd) + np.log(1 - self.probability)
        wrong = self._wrong(log_sd, log_sd)[1] + np.log(self.probability)
        return torch.logaddexp(right, wrong)


@dataclass(frozen=True)
class SpikeAndSlab(_RightOrWrong):
    r"""Each channel is right, or off by anything.

    .. math::
        x_o - x \sim (1 - \rho)\, N(0, s^2) + \rho\, t_3(0, S^2)

    Attributes:
        probability: Probability of misspecification of a channel, :math:`\rho`.
        spike: s; small beside the noise, which the predictive has already.
        slab: S.
    """

    probability: float = 0.1
    spike: float = 0.005
    slab: float = 10.0

    def _wrong(self, x: Tensor, log_sd: Tensor) -> tuple[Distribution, Tensor]:
        return dist.StudentT(3.0, x, self.slab), _student(3.0, self.slab, log_sd)


@dataclass(frozen=True)
class ChannelBias(_RightOrWrong):
    r"""Each channel is right or has a bias: :math:`x_o = x + m b`, b summed out.

    It is :class:`SpikeAndSlab` with a normal slab, for sensors whose zero has moved:
    :math:`m \sim \mathrm{Bernoulli}(\rho)`, :math:`b \sim N(0, B^2)`.

    Attributes:
        probability: :math:`\rho`.
        bias: B.
        spike: Deviation that is left without a bias.
    """

    probability: float = 0.1
    bias: float = 5.0
    spike: float = 0.005

    def _wrong(self, x: Tensor, log_sd: Tensor) -> tuple[Distribution, Tensor]:
        wide = (self.spike**2 + self.bias**2) ** 0.5
        return dist.Normal(x, wide), _known(wide, log_sd)


@dataclass(frozen=True)
class StudentError:
    r"""Every channel is off, some by much: :math:`x_o - x \sim t_\nu(0, s^2)`.

    Attributes:
        df: :math:`\nu`.
        scale: s.
        gross: Deviations s beyond which an error counts as misspecification.
    """

    df: float = 2.0
    scale: float = 0.05
    gross: float = 10.0

    def misspecified(self, x: Tensor, x_o: Tensor) -> Tensor:
        """Return whether errors are gross at denoised outcomes (n, q), shape (n, q)."""
        return ((x_o - x).abs() > self.gross * self.scale).to(x)

    def log_deviation(self, log_sd: Tensor) -> Tensor:
        """Return the log density of the log deviation of a channel's error, (n,)."""
        return _student(self.df, self.scale, log_sd)


def _known(sd: float, log_sd: Tensor, *, rounded: float = 0.1) -> Tensor:
    return dist.Normal(float(np.log(sd)), rounded).log_prob(log_sd)


def _student(df: float, scale: float, log_sd: Tensor) -> Tensor:
    """Return the log density of log(scale) + log(v) / 2, v inverse gamma."""
    v = torch.exp(2 * (log_sd - float(np.log(scale))))
    return dist.InverseGamma(0.5 * df, 0.5 * df).log_prob(v) + v.log() + np.log(2.0)
