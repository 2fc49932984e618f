"""Errors of a measurement, with their density written out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t

from sbi_active import GaussianNoise, StudentTNoise

Array = NDArray[Any]


class Error(Protocol):
    """The distribution of one number of x less its mean."""

    def log_prob(self, e: Array) -> Array:
        """Return log densities, of the shape of e."""
        ...

    def sample(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
        """Return independent errors."""
        ...

    def declared(self) -> Any:
        """Return the library's noise model; None where it has none."""
        ...


@dataclass(frozen=True)
class Normal:
    """Normal errors of a standard deviation."""

    sd: float

    def log_prob(self, e: Array) -> Array:
        return norm.logpdf(e, scale=self.sd)

    def sample(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
        return self.sd * rng.standard_normal(shape)

    def declared(self) -> Any:
        return GaussianNoise(self.sd)


@dataclass(frozen=True)
class Student:
    """Student t errors of a scale and degrees of freedom."""

    sd: float
    df: float

    def log_prob(self, e: Array) -> Array:
        return t.logpdf(e, self.df, scale=self.sd)

    def sample(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
        return self.sd * rng.standard_t(self.df, shape)

    def declared(self) -> Any:
        # The library declares the standard deviation, and not the scale.
        return StudentTNoise(self.sd * (self.df / (self.df - 2)) ** 0.5, self.df)


@dataclass(frozen=True)
class Uniform:
    """Errors anywhere within a width of zero, and nowhere else."""

    sd: float

    def log_prob(self, e: Array) -> Array:
        return np.where(np.abs(e) <= self.sd, -np.log(2 * self.sd), -np.inf)

    def sample(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
        return rng.uniform(-self.sd, self.sd, shape)

    def declared(self) -> Any:
        return None
