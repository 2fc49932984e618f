"""Coordinates in which a prior is nearly a standard normal, and has no edges."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.sampling.unbounding import Unbounding

Array = NDArray[Any]

NUM_DRAWS = 2_000  # of the prior, behind its moments
CHANCE = 5.0  # deviations of a correlation of independent draws that count as none
REACH = 8.0  # bound of a search, in deviations of the prior


class NormalCoordinates:
    r"""Maps parameters to u, in which the prior is close to :math:`N(0, I)`.

    An axis with two bounds goes to the line, where a uniform number is normal, one with
    one bound to its logarithm, and all are whitened by the prior's moments. Independent
    uniform, normal and log-normal priors become standard normal but for the noise of
    these; any other only sets the units of a search.

    Args:
        coordinates: Of the prior.
        rng: Source of the draws behind its moments.

    Attributes:
        low: Bounds of a search, shape (d,).
        high: As low.
        center: Mean of the normal that stands for the prior, shape (d,).
        precision: Its inverse variance, shape (d,).
    """

    def __init__(self, coordinates: PriorCoordinates, rng: np.random.Generator) -> None:
        self.base, self.dim = coordinates, coordinates.dim
        self.line = Unbounding(coordinates.bounded)
        y = self.line.to_line(coordinates.sample_prior(NUM_DRAWS, rng))
        self._shift, spread = y.mean(0), y.std(0)
        correlation = np.atleast_2d(np.corrcoef(y.T))
        correlation[np.abs(correlation) < CHANCE * NUM_DRAWS**-0.5] = 0.0
        np.fill_diagonal(correlation, 1.0)
        if np.linalg.eigvalsh(correlation)[0] < 1e-6:
            correlation = np.atleast_2d(np.corrcoef(y.T)) + 1e-6 * np.eye(self.dim)
        self._factor = spread[:, None] * np.linalg.cholesky(correlation)
        self._log_volume = float(np.log(np.diag(self._factor)).sum())
        self.low, self.high = np.full(self.dim, -REACH), np.full(self.dim, REACH)
        self.center, self.precision = np.zeros(self.dim), np.ones(self.dim)

    def from_z(self, z: Array) -> Array:
        """Return u, shape (n, d), of the prior's coordinates, shape (n, d)."""
        apart = self.line.to_line(z) - self._shift
        return np.linalg.solve(self._factor, apart.T).T

    def to_z(self, u: Array) -> Array:
        """Return the prior's coordinates, shape (n, d)."""
        return self.line.from_line(u @ self._factor.T + self._shift)

    def to_theta(self, u: Array) -> Tensor:
        """Return float32 parameters, shape (n, d)."""
        return self.base.to_theta(self.to_z(u))

    def log_prior(self, u: Array) -> Array:
        """Return the log density of u under the prior, shape (n,)."""
        y = u @ self._factor.T + self._shift
        slope = self.line.log_slope(y)
        return self.base.log_prior(self.line.from_line(y)) - slope + self._log_volume

    def log_slope(self, u: Array) -> Array:
        """Return log |d u / d z|, shape (n,)."""
        y = u @ self._factor.T + self._shift
        return self.line.log_slope(y) - self._log_volume

    def sample(self, num: int, rng: np.random.Generator) -> Array:
        """Return draws of the prior, shape (n, d)."""
        return self.from_z(self.base.sample_prior(num, rng))

    def splits_off(self, axes: NDArray[np.bool_], rng: np.random.Generator) -> bool:
        r"""Return whether the prior is a product over some axes and all others.

        Of two draws a and b, the density must not see which the axes come from:

        .. math::
            p(a)\, p(b) = p(a_S, b_R)\, p(b_S, a_R).
        """
        theta = self.base.to_theta(self.base.sample_prior(64, rng))
        a, b = theta[:32], theta[32:]
        mask = torch.from_numpy(axes)
        mixed = torch.where(mask, a, b), torch.where(mask, b, a)
        prior = self.base.prior
        apart, together = (
            torch.stack([prior.log_prob(part).double() for part in parts]).sum(0)
            for parts in (mixed, (a, b))
        )
        return bool(torch.allclose(apart, together, rtol=1e-4, atol=1e-3))
