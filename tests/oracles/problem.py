"""What a problem with a known answer is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from sbi.utils import BoxUniform
from scipy.special import log_ndtr, ndtr
from scipy.stats import norm, t
from torch import Tensor
from torch.distributions import Distribution, Independent
from torch.distributions import Normal as NormalPrior

from sbi_active import GaussianNoise, SimulatorModel, StudentTNoise

Array = NDArray[Any]
Mean = Callable[[Array, Array], Array]


@dataclass(frozen=True)
class Normal:
    """Normal errors of a standard deviation."""

    scale: float

    def log_prob(self, e: Array) -> Array:
        return norm.logpdf(e, scale=self.scale)

    def sample(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
        return self.scale * rng.standard_normal(shape)

    def declared(self) -> Any:
        return GaussianNoise(self.scale)


@dataclass(frozen=True)
class Student:
    """Student t errors of a scale and degrees of freedom."""

    scale: float
    df: float

    def log_prob(self, e: Array) -> Array:
        return t.logpdf(e, self.df, scale=self.scale)

    def sample(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
        return self.scale * rng.standard_t(self.df, shape)

    def declared(self) -> Any:
        # The library declares the standard deviation, and not the scale.
        return StudentTNoise(self.scale * (self.df / (self.df - 2)) ** 0.5, self.df)


@dataclass(frozen=True)
class Uniform:
    """Errors anywhere within a width of zero, and nowhere else."""

    scale: float

    def log_prob(self, e: Array) -> Array:
        return np.where(np.abs(e) <= self.scale, -np.log(2 * self.scale), -np.inf)

    def sample(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
        return rng.uniform(-self.scale, self.scale, shape)

    def declared(self) -> Any:
        return None


Error = Normal | Student | Uniform


class Space(Protocol):
    """A prior, with coordinates that are standard normal under it."""

    @property
    def prior(self) -> Distribution: ...

    def __call__(self, u: Array) -> Array:
        """Return parameters (n, d) of coordinates (n, d)."""
        ...


def one_region(theta: Array) -> Array:
    """Return the same region for all parameters, shape (n,)."""
    return np.zeros(len(theta), dtype=int)


@dataclass(frozen=True, kw_only=True)
class Problem:
    r"""Trials of a simulator whose posterior and evidence are known.

    Coordinates u are standard normal under the prior, so that

    .. math::
        Z = \int p(x | \theta(u)) \, \mathcal N(u | 0, I) \, du.

    Attributes:
        hard: What makes it hard, in one line.
        space: The prior of theta, and its coordinates.
        mean: Noise-free outcomes (n, q) of parameters (n, d) and actions (n, k); a row
            of NaN is no outcome.
        error: Of a number of x.
        action: Executed actions, shape (t, k).
        truth: Parameters behind the trials, shape (d,).
        seed: Seed of the errors of the trials.
        given: Observed outcomes, shape (t, q); None draws them.
        lost: Positions (trial, number) of x that were not observed.
        times: Times of the numbers of a trial; None where x is no trajectory.
        region: Label of each of some parameters (n, d), shape (n,): a mode, a side.
        is_smooth: Whether the mean can be differentiated.
        closed_form: Mean, covariance and log evidence of a problem whose parameters
            are the coordinates; None where there is none.
        name: Name of the function that gives it.
    """

    hard: str
    space: Space
    mean: Mean
    error: Error
    action: Array
    truth: Array
    seed: int = 0
    given: Array | None = None
    lost: tuple[tuple[int, int], ...] = ()
    times: Array | None = None
    region: Callable[[Array], Array] = one_region
    is_smooth: bool = True
    closed_form: Callable[[Any], tuple[Array, Array, float]] | None = None
    name: str = ""

    @property
    def dim(self) -> int:
        """Number of parameters."""
        return len(self.truth)

    @property
    def prior(self) -> Distribution:
        """The prior of theta, as a user gives it."""
        return self.space.prior

    def to_theta(self, u: Array) -> Array:
        """Return parameters (n, d) of coordinates (n, d)."""
        return self.space(u)

    @cached_property
    def x(self) -> Array:
        """Observed outcomes, shape (t, q)."""
        if self.given is not None:
            return self.given
        rows = np.repeat(self.truth[None], len(self.action), 0)
        x = self.mean(rows, self.action)
        x = x + self.error.sample(x.shape, np.random.default_rng(self.seed))
        for trial, number in self.lost:
            x[trial, number] = np.nan
        return x

    def means(self, theta: Array) -> Array:
        """Return noise-free outcomes of all trials, shape (n, t, q)."""
        n, t = len(theta), len(self.action)
        mean = self.mean(np.repeat(theta, t, 0), np.tile(self.action, (n, 1)))
        return mean.reshape(n, t, -1)

    def log_likelihood(self, theta: Array) -> Array:
        """Return log p(x | theta) of all trials, shape (n,).

        An outcome that was lost as a whole has the probability of being lost, zero or
        one; a number that was lost has been integrated out.
        """
        mean = self.means(theta)
        agree = np.isnan(mean).all(2) == np.isnan(self.x).all(1)
        e = self.x - mean
        log_p = np.where(np.isnan(e), 0.0, self.error.log_prob(e)).sum(2)
        return np.where(agree, log_p, -np.inf).sum(1)

    def log_density(self, u: Array) -> Array:
        """Return log likelihood plus log prior of coordinates (n, d), shape (n,)."""
        log_prior = -0.5 * (u**2).sum(1) - 0.5 * self.dim * np.log(2 * np.pi)
        return log_prior + self.log_likelihood(self.to_theta(u))

    def simulator(self, *, is_declared: bool) -> SimulatorModel:
        """Return the simulator as a user writes it.

        Args:
            is_declared: Whether the error is declared, and not drawn by the simulator.
        """

        def fn(theta: Tensor, action: Tensor) -> Tensor:
            mean = self.mean(theta.double().numpy(), action.double().numpy())
            if not is_declared:
                # From torch's generator, which the library seeds for each row.
                rng = np.random.default_rng(int(torch.randint(2**62, ())))
                mean = mean + self.error.sample(mean.shape, rng)
            return self.shaped(torch.from_numpy(mean).to(theta.dtype))

        times = None if self.times is None else torch.from_numpy(self.times).float()
        noise = self.error.declared() if is_declared else None
        return SimulatorModel(fn, noise=noise, sample_times=times)

    def shaped(self, x: Tensor) -> Tensor:
        """Return outcomes (n, q) as a user has them, by time and channel."""
        channels = 1 if self.times is None else x.shape[1] // len(self.times)
        return x if channels == 1 else x.reshape(len(x), -1, channels)

    def counted(self) -> tuple[Problem, list[int]]:
        """Return the same problem, and a list to which it adds its rows."""
        num: list[int] = []

        def mean(theta: Array, action: Array) -> Array:
            num.append(len(theta))
            return self.mean(theta, action)

        return replace(self, mean=mean, given=self.x), num

    def with_error(self, error: Error) -> Problem:
        """Return the posterior of the same trials under another error."""
        return replace(self, error=error, given=self.x)


@dataclass(frozen=True)
class Box:
    """Coordinates of a uniform prior.

    Attributes:
        low: Lower bounds, shape (d,).
        high: Upper bounds, shape (d,).
    """

    low: Array
    high: Array
    prior: Distribution = field(init=False)

    def __post_init__(self) -> None:
        low, high = (torch.from_numpy(v).float() for v in (self.low, self.high))
        object.__setattr__(self, "prior", BoxUniform(low, high))

    def __call__(self, u: Array) -> Array:
        """Return parameters, precise beside both bounds."""
        width = self.high - self.low
        return np.where(
            u < 0,
            self.low + width * np.exp(log_ndtr(np.minimum(u, 0.0))),
            self.high - width * ndtr(-np.maximum(u, 0.0)),
        )


def box(low: list[float], high: list[float]) -> Box:
    """Return a uniform prior with its coordinates."""
    return Box(np.array(low, dtype=float), np.array(high, dtype=float))


@dataclass(frozen=True)
class Gauss:
    """Coordinates of an independent normal prior.

    Attributes:
        center: Means, shape (d,).
        sd: Standard deviations, shape (d,).
    """

    center: Array
    sd: Array
    prior: Distribution = field(init=False)

    def __post_init__(self) -> None:
        center, sd = (torch.from_numpy(v).float() for v in (self.center, self.sd))
        prior: Any = Independent(NormalPrior(center, sd), 1)
        object.__setattr__(self, "prior", prior)

    def __call__(self, u: Array) -> Array:
        """Return parameters."""
        return self.center + self.sd * u


def gauss(dim: int, center: float = 0.0, sd: float = 1.0) -> Gauss:
    """Return a normal prior with its coordinates."""
    return Gauss(np.full(dim, center), np.full(dim, sd))
