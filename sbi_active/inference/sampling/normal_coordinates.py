"""Coordinates in which a prior has no mean and unit variance."""

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
UNIFORM = 3**-0.5  # deviation of a uniform number between -1 and 1
FLAT_ERROR = UNIFORM * (0.2 / NUM_DRAWS) ** 0.5  # of the deviation of its draws
INSIDE = 1 - 1e-6  # bound of a search between -1 and 1, which single precision keeps


class NormalCoordinates:
    r"""Maps parameters to u, in which the prior has no mean and unit covariance.

    An axis with one bound goes to its logarithm, and all are whitened by the prior's
    moments. An axis with two bounds that others do not depend on keeps them: what is
    straight stays so up to the edge, and is cut there. Where axes depend on each other,
    or on request, they go to the line, where a uniform number is normal: bounds of what
    is whitened together would be oblique, and a smooth density would be cut.

    Args:
        coordinates: Coordinates of the prior.
        rng: Source of the draws behind its moments.
        keeps_edges: Whether axes keep two bounds.

    Attributes:
        low: Lower bounds of a search, shape (d,).
        high: Upper bounds of a search, shape (d,).
        center: Mean of the normal that stands for the prior, shape (d,).
        precision: Inverse variance, shape (d,): 0 of a uniform number, which has its
            bounds, and up to 1 of one that is narrow between them.
    """

    def __init__(
        self,
        coordinates: PriorCoordinates,
        rng: np.random.Generator,
        *,
        keeps_edges: bool = True,
    ) -> None:
        self.base, self.dim = coordinates, coordinates.dim
        z, bounded = coordinates.sample_prior(NUM_DRAWS, rng), coordinates.bounded
        self.line = Unbounding(bounded)
        correlation = _correlation(self.line.to_line(z))
        apart = np.abs(correlation - np.eye(self.dim)).max(1) == 0
        kept = bounded & apart & keeps_edges
        self.line = Unbounding(bounded & ~kept)
        y = self.line.to_line(z)
        shift, spread = y.mean(0), y.std(0)
        # The moments of a uniform number are known.
        is_flat = kept & (np.abs(spread - UNIFORM) < CHANCE * FLAT_ERROR)
        self._shift = np.where(is_flat, 0.0, shift)
        spread = np.where(is_flat, UNIFORM, spread)
        self._factor = spread[:, None] * np.linalg.cholesky(correlation)
        self._log_volume = float(np.log(np.diag(self._factor)).sum())
        low, high = ((end - self._shift) / spread for end in (-INSIDE, INSIDE))
        self.low, self.high = np.where(kept, low, -REACH), np.where(kept, high, REACH)
        share = np.maximum(1 - (spread / UNIFORM) ** 2, 0.0)
        self.center, self.precision = np.zeros(self.dim), np.where(kept, share, 1.0)

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

        The density must not depend on which of two draws a and b the axes come from:

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


def _correlation(y: Array) -> Array:
    """Return correlations of draws (n, d) without those that chance may give."""
    raw = np.atleast_2d(np.corrcoef(y.T))
    found = np.where(np.abs(raw) < CHANCE * len(y) ** -0.5, 0.0, raw)
    np.fill_diagonal(found, 1.0)
    if np.linalg.eigvalsh(found)[0] < 1e-6:
        return raw + 1e-6 * np.eye(len(raw))
    return found
