"""Interface of a noise model, and the family with a standard deviation a channel."""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from typing import Any

import torch
from torch import Tensor
from typing_extensions import Self, override

from sbi_active.arrays import own_tensor
from sbi_active.expected import require
from sbi_active.seeding import forked_generators, row_normals, row_uniforms
from sbi_active.simulation.noise.posterior import NoisePosterior

LOG_2PI = math.log(2 * math.pi)


class NoiseModel(ABC):
    r"""Distribution of an observation around the simulator's noise-free output.

    A number of x that is NaN was not observed and is integrated out exactly; a row
    without any number has log density 0. Where x has a number and the mean has none,
    the log density is minus infinity, and observations of a mean that is NaN are NaN.

    Parameters are declared exactly, or have a posterior :math:`p(\eta | D)`. With one,
    samples and densities are those of the marginal

    .. math::
        p(x | \mu) = \int p(x | \mu, \eta) \, p(\eta | D) \, d\eta

    of every row by itself: each has a draw of its own. Where several rows share one
    unknown :math:`\eta`, draw it from ``posterior`` and declare the noise with it.

    Attributes:
        parameter_names: Names of the parameters.
        parameters: Values of the parameters in natural units, shape (p,), float64.
        posterior: Posterior of the parameters, event shape (p,); None if they are
            declared exactly.
        times: Time stamps of the first axis of x in seconds, shape (T,) or one set a
            row (n, T); None if they were not given.
        measurement_sd: Known standard deviation of the measurement alone, where the
            noise also stands for what a simulator gets wrong; None if it does not.
        is_known_gaussian: Whether it is Gaussian and nothing of it is unknown.
    """

    parameter_names: tuple[str, ...] = ()
    parameters: Tensor = torch.empty(0, dtype=torch.float64)
    posterior: Any = None
    times: Tensor | None = None
    measurement_sd: float | Tensor | None = None
    is_known_gaussian: bool = False

    def at(self, times: Tensor | None) -> Self:
        """Return the same noise at time stamps, (T,) or one set a row, in seconds."""
        noise = copy.copy(self)
        noise.times = (
            None if times is None else own_tensor(times, torch.float64, name="times")
        )
        return noise

    @abstractmethod
    def sample(self, mean: Tensor, seeds: Tensor | None = None) -> Tensor:
        """Return observations.

        Args:
            mean: Noise-free outputs, shape (n, *x_shape).
            seeds: Seeds, one a row, shape (n,), and row i depends on ``seeds[i]``
                alone; None draws from torch's global generator.

        Returns:
            Shape (n, *x_shape).
        """

    @abstractmethod
    def log_prob(self, x: Tensor, mean: Tensor) -> Tensor:
        """Return the log density of observations.

        Args:
            x: Observations, shape (n, *x_shape); NaN where a number was not observed.
            mean: Noise-free outputs, broadcastable to x.

        Returns:
            Shape (n,), float64, nats.
        """

    def whiten(self, value: Tensor) -> Tensor:
        r"""Return :math:`C^{-1/2} v` for the covariance C, shape (n, \*x_shape).

        Unknown parameters are at the values that the noise declares for them, and heavy
        tails count by their standard deviation.

        Args:
            value: v, in the units of x, shape (n, \*x_shape); NaN where not observed.

        Returns:
            Float64; NaN where not observed.
        """
        sds = self.declared_sds()
        return value.double() / (sds if len(sds) > 1 else sds[0])

    def declared_sds(self, *, num: int = 4_096) -> Tensor:
        """Return the standard deviations, shape (1,) or (channels,).

        A noise model that has no such parameter is sampled around zero.
        """
        named = zip(self.parameter_names, self.parameters, strict=True)
        if sds := [value for name, value in named if name.startswith("sd")]:
            return torch.stack(sds).double()
        with forked_generators(0, "sd"):
            draws = self.sample(torch.zeros(num, 1, dtype=torch.float64))
        return draws.std().reshape(1).double()


class ScaleNoise(NoiseModel):
    r"""Noise with a standard deviation and further parameters common to all channels.

    This class has the checks, the shapes and the densities of Gaussian noise, whose
    numbers are independent once they are whitened by :meth:`_innovations`; it is
    independent noise. A subclass says how numbers depend on each other, and draws them.

    Args:
        sd: Standard deviation, in the units of x; a number, or one a channel (the last
            axis of x). Its parameters are named "sd", or "sd_1", "sd_2", ...
        posterior: Posterior of the parameters, event shape (p,), as
            :func:`.estimate_noise` makes it.
        **shared: Further parameters, which follow those.

    Raises:
        ValueError: If a parameter is negative or not finite.
    """

    #: Axes of x, rows among them, that are no channels.
    _num_axes = 1

    def __init__(
        self,
        sd: float | Tensor,
        *,
        posterior: NoisePosterior | None = None,
        **shared: float | Tensor,
    ) -> None:
        self.sd = own_tensor(sd, torch.float64, name="sd")
        require(
            self.sd.ndim < 2,
            "a standard deviation that is a number or one a channel",
            f"shape {tuple(self.sd.shape)}",
            "give shape () or (channels,)",
        )
        self._num_sd = self.sd.numel()
        names = [f"sd_{c + 1}" for c in range(self._num_sd)] if self.sd.ndim else ["sd"]
        values = [own_tensor(v, torch.float64, name=k) for k, v in shared.items()]
        self.parameter_names = (*names, *shared)
        self.parameters = torch.cat([v.reshape(-1) for v in (self.sd, *values)])
        self.posterior = posterior
        self.is_known_gaussian = posterior is None
        named = zip(self.parameter_names, self.parameters.tolist(), strict=True)
        for name, value in named:
            expected = f"a finite {name} >= 0"
            require(0 <= value < math.inf, expected, value, "correct it")

    def __repr__(self) -> str:
        named = [*zip(self.parameter_names, self.parameters.tolist(), strict=True)]
        parts = {"sd": self.sd.tolist(), **dict(named[self._num_sd :])}
        text = ", ".join(f"{k}={v}" for k, v in parts.items())
        known = "" if self.posterior is None else ", with a posterior"
        return f"{type(self).__name__}({text}{known})"

    @override
    def sample(self, mean: Tensor, seeds: Tensor | None = None) -> Tensor:
        shape, num = mean.shape, len(self.parameters)
        self._require_channels(shape)
        rows = self.parameters.expand(len(mean), -1)
        if self.posterior is not None:
            if seeds is None:
                uniform = torch.rand(len(mean), num, dtype=torch.float64)
            else:  # behind the numbers that the noise itself takes
                uniform = row_uniforms(seeds, num, first=2 * math.prod(shape[1:]))
            rows = self.posterior.quantile(uniform)
        return mean + self._draw(seeds, shape, rows).to(mean)

    @override
    def log_prob(self, x: Tensor, mean: Tensor) -> Tensor:
        x, mean = torch.broadcast_tensors(x.double(), mean.double())
        self._require_channels(x.shape)
        observed = ~x.isnan()
        impossible = observed & ~(x.isfinite() & mean.isfinite())
        residual = torch.where(observed & ~impossible, x - mean, torch.nan)
        if self.posterior is not None:
            density = self._log_marginal(residual, self.posterior)
        else:
            is_positive = bool((self.sd > 0).all())
            expected = "a standard deviation > 0 for a density"
            advice = "give the noise of every channel"
            require(is_positive, expected, "0, at which there is none", advice)
            terms = torch.where(residual.isnan(), 0.0, self._log_density(residual))
            density = terms.flatten(1).sum(1)
        return density.masked_fill(impossible.flatten(1).any(1), -torch.inf)

    @override
    def whiten(self, value: Tensor) -> Tensor:
        return self._innovations(value.double(), self._shared)[0] / self.sd

    def _draw(self, seeds: Tensor | None, shape: torch.Size, rows: Tensor) -> Tensor:
        """Return noise of a shape (n, *x_shape), float64, by parameters (n, p)."""
        return self._by_row(rows, shape) * standard_normals(seeds, shape)

    def _log_density(self, residual: Tensor) -> Tensor:
        """Return log densities of numbers given those before, of the residual's shape.

        The residual is NaN where x was not observed, and what is returned there is
        ignored.
        """
        u, log_variance = self._innovations(residual, self._shared)
        sd = self.sd.to(residual)
        return -0.5 * (u / sd) ** 2 - sd.log() - 0.5 * LOG_2PI - 0.5 * log_variance

    def _log_marginal(self, residual: Tensor, posterior: NoisePosterior) -> Tensor:
        """Return log densities (n,) with the parameters summed out, exactly."""
        count = self._by_channel(~residual.isnan())
        terms = []
        for cell, (shared, log_p) in enumerate(posterior.cells):
            u, log_variance = self._innovations(residual, shared)
            known = u.square(), log_variance.expand(u.shape)
            square, factor = (self._by_channel(part) for part in known)
            each = posterior.sd.log_evidence(square, count, cell) - 0.5 * factor
            terms.append(each.sum(1) + log_p)
        return torch.stack(terms).logsumexp(0)

    def _innovations(self, residual: Tensor, shared: float) -> tuple[Tensor, Tensor]:
        """Return independent numbers of variance sd^2, and log variances in sd^2.

        Args:
            residual: Residuals, shape (n, *x_shape), NaN where not observed.
            shared: The parameter that channels share.
        """
        return residual, torch.zeros(())

    @property
    def _shared(self) -> float:
        return float(self.parameters[-1])

    def _require_channels(self, shape: torch.Size) -> None:
        """Raise if outcomes (n, *x_shape) do not fit the channels."""
        num = shape[-1] if len(shape) > self._num_axes else 1
        require(
            len(shape) > 1 and self._num_sd in (1, num),
            f"outcomes of shape (n, ..., {self._num_sd}), one standard deviation a "
            "channel",
            tuple(shape),
            "give one number, or one an entry of the last axis",
        )

    def _by_row(self, rows: Tensor, shape: torch.Size) -> Tensor:
        """Return standard deviations among parameters (n, p), for (n, *x_shape)."""
        sd = rows[:, : self._num_sd]
        return sd.reshape(len(rows), *[1] * (len(shape) - 2), sd.shape[1])

    def _by_channel(self, terms: Tensor) -> Tensor:
        """Return sums over all but the channels, (n, *x_shape) -> (n, num_sd)."""
        return (
            terms.double().nan_to_num(0.0).reshape(len(terms), -1, self._num_sd).sum(1)
        )


def standard_normals(seeds: Tensor | None, shape: torch.Size) -> Tensor:
    """Return standard normal numbers of a shape (n, *x_shape), float64."""
    if seeds is None:
        return torch.randn(shape, dtype=torch.float64)
    return row_normals(seeds, math.prod(shape[1:])).reshape(shape)
