"""Errors of a measurement, with their density written out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t

from sbi_active import GaussianNoise, StudentTNoise

Array = NDArray[Any]


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
