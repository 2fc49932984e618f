"""Features in which a region's outcomes are regressed on the parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True)
class Basis:
    """Monomials up to a degree, and random cosines.

    Attributes:
        degree: Degree of the monomials.
        frequency: Shape (d, w), w = 0 for none.
        phase: Shape (w,).
        is_additive: Whether monomials are powers of one coordinate each.
    """

    degree: int
    frequency: Array
    phase: Array
    is_additive: bool = False

    @staticmethod
    def polynomial(degree: int, dim: int, *, is_additive: bool = False) -> Basis:
        """Return a basis without cosines."""
        return Basis(degree, np.zeros((dim, 0)), np.zeros(0), is_additive)

    @staticmethod
    def waves(length: float, dim: int, num: int) -> Basis:
        """Return quadratics and cosines (Rahimi & Recht, NeurIPS 2007)."""
        rng = np.random.default_rng(7)  # any fixed directions will do
        frequency = rng.standard_normal((dim, num)) / length
        return Basis(2, frequency, rng.uniform(0, 2 * np.pi, num))

    @property
    def num_features(self) -> int:
        """Number p of features."""
        dim, num_waves = self.frequency.shape
        if self.is_additive:
            return 1 + self.degree * dim + num_waves
        return math.comb(dim + self.degree, self.degree) + num_waves

    def __call__(self, u: Array) -> Array:
        """Return features, shape (n, p), of coordinates, shape (n, d)."""
        if self.is_additive:
            powers = [u**degree for degree in range(1, self.degree + 1)]
            return np.concatenate([np.ones((len(u), 1)), *powers], 1)
        monomials = [np.ones(len(u))]
        last = [(0, monomials[0])]
        for _ in range(self.degree):
            last = [
                (j, column * u[:, j])
                for first, column in last
                for j in range(first, u.shape[1])
            ]
            monomials += [column for _, column in last]
        features = np.stack(monomials, 1)
        if self.phase.size == 0:
            return features
        return np.concatenate([features, np.cos(u @ self.frequency + self.phase)], 1)
