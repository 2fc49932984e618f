"""Interface of a noise model, and the base of those with a standard deviation."""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import Self, override

from sbi_active.arrays import own_tensor
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
    posterior: Distribution | None = None
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

    This class has the checks and shapes, and sums over a posterior; its noise is
    independent and Gaussian. Another kind implements ``_draw`` and ``_log_density``
    given parameters, and ``_log_evidence`` given a cell of what channels share if it is
    Gaussian.

    Args:
        sd: Standard deviation, in the units of x; a number, or one a channel (the last
            axis of x). Its parameters are named "sd", or "sd_1", "sd_2", ...
        shared: Further parameters by name, which follow those.
        posterior: Posterior of the parameters, event shape (p,). One that
            :func:`.estimate_noise` did not make is represented by 256 fixed draws of
            equal weight.
    """

    _is_gaussian = True

    def __init__(
        self,
        sd: float | Tensor,
        *,
        shared: Mapping[str, float | Tensor] | None = None,
        posterior: Distribution | None = None,
    ) -> None:
        self.sd = own_tensor(sd, torch.float64, name="sd")
        if self.sd.ndim > 1:
            raise ValueError(
                "expected a standard deviation that is a number or one a channel; got "
                f"shape {tuple(self.sd.shape)}; give shape () or (channels,)"
            )
        self._num_sd = self.sd.numel()
        shared = {} if shared is None else shared
        names = [f"sd_{c + 1}" for c in range(self._num_sd)] if self.sd.ndim else ["sd"]
        self.parameter_names = (*names, *shared)
        values = [own_tensor(v, torch.float64, name=k) for k, v in shared.items()]
        self.parameters = torch.cat(
            [self.sd.reshape(-1), *(v.reshape(1) for v in values)]
        )
        self.posterior = posterior
        self._table: Tensor | None = None
        self._check(self.parameters)

    def __repr__(self) -> str:
        values = self.parameters[self._num_sd :].tolist()
        names = self.parameter_names[self._num_sd :]
        parts = {"sd": self.sd.tolist(), **dict(zip(names, values, strict=True))}
        text = ", ".join(f"{k}={v}" for k, v in parts.items())
        known = "" if self.posterior is None else ", with a posterior"
        return f"{type(self).__name__}({text}{known})"

    @property
    def is_known_gaussian(self) -> bool:  # pyright: ignore
        """Whether it is Gaussian and nothing of it is unknown."""
        return self._is_gaussian and self.posterior is None

    @override
    def sample(self, mean: Tensor, seeds: Tensor | None = None) -> Tensor:
        shape = mean.shape
        self._check_shape(shape)
        rows = self.parameters.expand(len(mean), -1)
        if self.posterior is not None:
            rows = self._draw_parameters(seeds, shape)
            self._check(rows)
        return mean + self._draw(seeds, shape, rows).to(mean)

    @override
    def log_prob(self, x: Tensor, mean: Tensor) -> Tensor:
        x, mean = _broadcast(x, mean)
        self._check_shape(x.shape)
        observed = ~x.isnan()
        impossible = observed & ~(x.isfinite() & mean.isfinite())
        residual = torch.where(observed & ~impossible, x - mean, torch.nan)
        if self.posterior is not None:
            density = self._marginal(residual)
        else:
            if not bool((self.parameters[: self._num_sd] > 0).all()):
                raise ValueError(
                    "expected a standard deviation > 0 for a density; got 0, at which "
                    "there is none; give the noise of every channel"
                )
            rows = self.parameters.expand(len(x), -1).to(x.device)
            density = self._log_density(residual, rows)
        return density.masked_fill(impossible.flatten(1).any(1), -torch.inf)

    def _draw(self, seeds: Tensor | None, shape: torch.Size, rows: Tensor) -> Tensor:
        """Return noise of a shape (n, *x_shape), float64, by parameters (n, p)."""
        return self._spread(rows, shape) * standard_normals(seeds, shape)

    def _log_density(self, residual: Tensor, rows: Tensor) -> Tensor:
        """Return log densities (n,) of residuals, NaN where not observed."""
        sd = self._spread(rows, residual.shape)
        density = -0.5 * (residual / sd) ** 2 - torch.log(sd) - 0.5 * LOG_2PI
        return observed_terms(density, residual).flatten(1).sum(1)

    def _marginal(self, residual: Tensor) -> Tensor:
        """Return log densities (n,) averaged over the posterior.

        It is exact for Gaussian noise and a posterior of this library, else by fixed
        draws.
        """
        posterior = self.posterior
        if self._is_gaussian and isinstance(posterior, NoisePosterior):
            terms = [
                self._log_evidence(residual, posterior, k).sum(1) + log_p
                for k, (_, log_p) in enumerate(posterior.cells)
            ]
            return torch.stack(terms).logsumexp(0)
        draws = self._fixed_draws().to(residual.device)
        each = draws[:, None].expand(-1, len(residual), -1)
        terms = [self._log_density(residual, rows) for rows in each]
        return torch.stack(terms).logsumexp(0) - math.log(len(draws))

    def _log_evidence(self, residual: Tensor, p: NoisePosterior, cell: int) -> Tensor:
        """Return log densities by channel with its size summed out, (n, num_sd)."""
        square = self._by_channel(observed_terms(residual.square(), residual))
        count = self._by_channel((~residual.isnan()).double())
        return p.sd.log_evidence(square, count, cell)

    def _check(self, parameters: Tensor) -> None:
        """Raise if parameters (..., p) are outside their range."""
        sd = parameters[..., : self._num_sd]
        if not bool((sd.isfinite() & (sd >= 0)).all()):
            raise ValueError(
                f"expected a standard deviation >= 0; got {sd.tolist()}; give it in "
                "the units of x"
            )

    def _check_shape(self, shape: torch.Size) -> None:
        """Raise if outcomes (n, *x_shape) do not fit the channels."""
        if len(shape) < 2 or self._num_sd not in (1, shape[-1]):
            raise ValueError(
                f"expected outcomes of shape (n, ..., {self._num_sd}), one standard "
                f"deviation a channel; got {tuple(shape)}; give one number, or one "
                "an entry of the last axis"
            )

    def _draw_parameters(self, seeds: Tensor | None, shape: torch.Size) -> Tensor:
        """Return one draw of the posterior a row, shape (n, p)."""
        num = len(self.parameter_names)
        if seeds is None:
            uniform = torch.rand(shape[0], num, dtype=torch.float64)
        else:  # behind the numbers that the noise itself takes
            uniform = row_uniforms(seeds, num, first=2 * math.prod(shape[1:]))
        if isinstance(self.posterior, NoisePosterior):
            return self.posterior.quantile(uniform)
        draws = self._fixed_draws()
        return draws[(uniform[:, 0] * len(draws)).long()]

    def _fixed_draws(self, *, num: int = 256) -> Tensor:
        if self._table is None:
            assert self.posterior is not None
            with forked_generators(0, "noise posterior"):
                self._table = self.posterior.sample((num,)).double()
        return self._table

    def _spread(self, sd: Tensor, shape: torch.Size) -> Tensor:
        """Return standard deviations (n, channels) for shape (n, *x_shape)."""
        return sd.reshape(len(sd), *[1] * (len(shape) - 2), self._num_sd)

    def _by_channel(self, terms: Tensor) -> Tensor:
        """Return sums over all but the channels, (n, *x_shape) -> (n, num_sd)."""
        return terms.reshape(len(terms), -1, self._num_sd).sum(1)


def observed_terms(terms: Tensor, residual: Tensor) -> Tensor:
    """Return terms of a sum, zero if the residual was not observed."""
    return torch.where(residual.isnan(), 0.0, terms)


def standard_normals(seeds: Tensor | None, shape: torch.Size) -> Tensor:
    """Return standard normal numbers of a shape (n, *x_shape), float64."""
    if seeds is None:
        return torch.randn(shape, dtype=torch.float64)
    return row_normals(seeds, math.prod(shape[1:])).reshape(shape)


def _broadcast(x: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
    try:
        x, mean = torch.broadcast_tensors(x.double(), mean.double())
    except RuntimeError as error:
        raise ValueError(
            "expected a mean broadcastable to x; got shapes "
            f"{tuple(mean.shape)} and {tuple(x.shape)}; give one mean a row"
        ) from error
    return x, mean
