"""Coordinates of a prior: of unit size, and of no mean and unit covariance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.arrays import Array
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.support import support_bounds, support_of, within_support

UNIFORM = 3**-0.5  # deviation of a uniform number between -1 and 1


class PriorCoordinates:
    r"""Maps parameters to coordinates z, axis by axis, and the prior to their density.

    An axis bounded on both sides keeps its shape and becomes [-1, 1], so that a model
    linear in theta stays linear. An axis bounded on one side, such as a log-normal
    prior's, becomes a logarithm, then, as any unbounded one, is scaled by the prior:

    .. math::
        z = \frac{t(\theta) - a}{b}, \qquad
        \log p(z) = \log p(\theta) + \sum_j \log \left|
        \frac{\partial \theta_j}{\partial z_j} \right|.

    Args:
        prior: The prior p, with a support.
        rng: Source of the prior draws that give the scale.
        reach: Prior deviations at which the half-width 1 of an unbounded coordinate
            lies.
        num_draws: Number of draws of the prior behind its moments, known to a fiftieth.

    Attributes:
        bounded: Axes with two bounds, shape (d,), bool.
    """

    def __init__(
        self,
        prior: Distribution,
        rng: np.random.Generator,
        *,
        reach: float = 2.5,
        num_draws: int = 2_000,
    ) -> None:
        self.prior = prior
        with forked_generators(int(rng.integers(2**31))):
            theta = prior.sample(torch.Size([num_draws])).double().numpy()
        self.dim = theta.shape[1]
        self.low, self.high = support_bounds(support_of(prior), self.dim)
        self.bounded = np.isfinite(self.low) & np.isfinite(self.high)
        # +1 for theta > low, -1 for theta < high, 0 for no logarithm.
        self._side = np.isfinite(self.low).astype(int) - np.isfinite(self.high)
        raw = self._forward(theta)
        self._shift, self._scale = raw.mean(0), reach * raw.std(0)
        low, high = self.low[self.bounded], self.high[self.bounded]
        self._shift[self.bounded] = 0.5 * (low + high)
        self._scale[self.bounded] = 0.5 * (high - low)

    def to_z(self, theta: Tensor) -> Array:
        """Return coordinates, shape (n, d), of parameters, shape (n, d)."""
        raw = self._forward(theta.double().numpy())
        return (raw - self._shift) / self._scale

    def to_theta(self, z: Array) -> Tensor:
        """Return float32 parameters, shape (n, d), of coordinates, shape (n, d)."""
        raw = z * self._scale + self._shift
        edge = np.where(self._side > 0, self.low, self.high)
        with np.errstate(over="ignore", invalid="ignore"):
            logarithmic = edge + self._side * np.exp(raw)
        theta = np.where(self._side == 0, raw, logarithmic)
        return torch.from_numpy(theta.astype(np.float32))

    def inside(self, z: Array) -> NDArray[np.bool_]:
        """Return whether the parameters lie in the prior's support, shape (n,)."""
        theta = self.to_theta(z)
        if not len(theta):  # which constraints of a mixed prior cannot reshape
            return np.zeros(0, dtype=bool)
        finite = theta.isfinite().all(-1)
        inside = within_support(self.prior, torch.nan_to_num(theta))
        return (finite & inside).numpy()

    def log_prior(self, z: Array) -> Array:
        """Return the log density of z under the prior, shape (n,)."""
        log_prior = np.full(len(z), -np.inf)
        inside = self.inside(z)
        if inside.any():
            theta = self.to_theta(z[inside])
            log_prior[inside] = self.prior.log_prob(theta).double().numpy()
        return log_prior + self.log_jacobian(z)

    def log_jacobian(self, z: Array) -> Array:
        """Return log |d theta / d z|, shape (n,)."""
        curved = self._side != 0
        raw = z[:, curved] * self._scale[curved] + self._shift[curved]
        return np.log(self._scale).sum() + raw.sum(1)

    def sample_prior(self, num_samples: int, rng: np.random.Generator) -> Array:
        """Return coordinates of draws from the prior, shape (n, d)."""
        with forked_generators(int(rng.integers(2**31))):
            # Some priors cannot draw nothing.
            theta = self.prior.sample(torch.Size([max(num_samples, 1)]))
        return self.to_z(theta[:num_samples])

    def drawn_from(
        self, others: Sequence[Distribution], num_samples: int, *, seed: int
    ) -> list[Array]:
        """Return coordinates of draws of other distributions, each of shape (n, d).

        Draws outside the support are left out, and distributions that have no others.
        """
        found = []
        for other in others:
            with forked_generators(derive_seed(seed, "start")):
                z = self.to_z(other.sample(torch.Size([num_samples])).float())
            found.append(z[self.inside(z)])
        return [z for z in found if len(z)]

    def _forward(self, theta: Array) -> Array:
        with np.errstate(invalid="ignore", divide="ignore"):
            above, below = np.log(theta - self.low), np.log(self.high - theta)
        logarithm = np.where(self._side > 0, above, below)
        return np.where(self._side == 0, theta, logarithm)


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
        num_draws: Number of draws of the prior behind its moments.
        chance: Standard errors of a moment of independent draws that count as chance.
        searched: Bound of a search, in deviations of the prior.
        inside: Bound of a search between -1 and 1, which single precision keeps.

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
        num_draws: int = 2_000,
        chance: float = 5.0,
        searched: float = 8.0,
        inside: float = 1 - 1e-6,
    ) -> None:
        self.base, self.dim = coordinates, coordinates.dim
        z, bounded = coordinates.sample_prior(num_draws, rng), coordinates.bounded
        self._lined = bounded
        correlation = _correlation(self._to_line(z), chance)
        apart = np.abs(correlation - np.eye(self.dim)).max(1) == 0
        kept = bounded & apart & keeps_edges
        self._lined = bounded & ~kept
        y = self._to_line(z)
        shift, spread = y.mean(0), y.std(0)
        # The moments of a uniform number are known.
        error = UNIFORM * (0.2 / num_draws) ** 0.5  # of the deviation of its draws
        is_flat = kept & (np.abs(spread - UNIFORM) < chance * error)
        self._shift = np.where(is_flat, 0.0, shift)
        spread = np.where(is_flat, UNIFORM, spread)
        self._factor = spread[:, None] * np.linalg.cholesky(correlation)
        self._log_volume = float(np.log(np.diag(self._factor)).sum())
        low, high = ((end - self._shift) / spread for end in (-inside, inside))
        self.low = np.where(kept, low, -searched)
        self.high = np.where(kept, high, searched)
        share = np.maximum(1 - (spread / UNIFORM) ** 2, 0.0)
        self.center, self.precision = np.zeros(self.dim), np.where(kept, share, 1.0)

    def from_z(self, z: Array) -> Array:
        """Return u, shape (n, d), of the prior's coordinates, shape (n, d)."""
        apart = self._to_line(z) - self._shift
        return np.linalg.solve(self._factor, apart.T).T

    def to_z(self, u: Array) -> Array:
        """Return the prior's coordinates, shape (n, d)."""
        z = u @ self._factor.T + self._shift
        z[:, self._lined] = 2 * ndtr(z[:, self._lined]) - 1
        return z

    def to_theta(self, u: Array) -> Tensor:
        """Return float32 parameters, shape (n, d)."""
        return self.base.to_theta(self.to_z(u))

    def log_prior(self, u: Array) -> Array:
        """Return the log density of u under the prior, shape (n,)."""
        log_prior = self.base.log_prior(self.to_z(u))
        return log_prior - self._line_slope(u) + self._log_volume

    def log_slope(self, u: Array) -> Array:
        """Return log |d u / d z|, shape (n,)."""
        return self._line_slope(u) - self._log_volume

    def _to_line(self, z: Array) -> Array:
        """Return z with some axes on the real line; what is outside goes to the end."""
        y, share = z.copy(), 0.5 * (1 + z[:, self._lined])
        y[:, self._lined] = ndtri(share.clip(1e-15, 1 - 1e-15))
        return y

    def _line_slope(self, u: Array) -> Array:
        """Return the log slope of what goes to the line, shape (n,)."""
        square = (u @ self._factor.T + self._shift)[:, self._lined] ** 2
        return (0.5 * square + 0.5 * np.log(0.5 * np.pi)).sum(1)

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


def near_ends(
    place: Array, weight: Array | None = None, *, share: float = 0.01, wide: float = 3.0
) -> Array:
    """Return the masses of draws near the lower and the upper ends of ranges, (2, d).

    In a wide prior all of a narrow posterior may be in the last hundredth, and far from
    the end in its own deviations: there the end changes nothing.

    Args:
        place: Places of the draws between the ends, from 0 to 1, shape (n, d).
        weight: Weights of the draws, shape (n,); None are equal ones.
        share: Share of the range that is near an end.
        wide: Deviations of the draws from it that are.
    """
    own = np.full(len(place), 1 / len(place)) if weight is None else weight
    sd = np.sqrt(own @ (place - own @ place) ** 2)
    reach = np.clip(wide * sd, 1e-6, share)  # all of them may be at the end
    return np.stack([own @ (place <= reach), own @ (1 - place <= reach)])


def _correlation(y: Array, chance: float) -> Array:
    """Return correlations of draws (n, d) without those that chance may give."""
    raw = np.atleast_2d(np.corrcoef(y.T))
    found = np.where(np.abs(raw) < chance * len(y) ** -0.5, 0.0, raw)
    np.fill_diagonal(found, 1.0)
    if np.linalg.eigvalsh(found)[0] < 1e-6:
        return raw + 1e-6 * np.eye(len(raw))
    return found
