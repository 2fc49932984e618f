"""Coordinates in which a prior is of unit size, for methods that work in regions."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sbi.utils.sbiutils import within_support
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.seeding import forked_generators

Array = NDArray[Any]

#: Where the half-width 1 of an unbounded coordinate lies, in prior deviations.
REACH = 2.5


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

    Attributes:
        bounded: Axes with two bounds, shape (d,), bool.
    """

    def __init__(self, prior: Distribution, rng: np.random.Generator) -> None:
        self.prior = prior
        with forked_generators(int(rng.integers(2**31))):
            theta = prior.sample(torch.Size([2_000])).double().numpy()
        self.dim = theta.shape[1]
        self.low, self.high = support_bounds(prior.support, self.dim)
        self.bounded = np.isfinite(self.low) & np.isfinite(self.high)
        # +1 for theta > low, -1 for theta < high, 0 for no logarithm.
        self._side = np.isfinite(self.low).astype(int) - np.isfinite(self.high)
        raw = self._forward(theta)
        self._shift, self._scale = raw.mean(0), REACH * raw.std(0)
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

    def pulled_inside(self, center: Array, z: Array, rng: np.random.Generator) -> Array:
        """Return z (n, d), drawn towards a center where bounded axes would be left.

        The place on the way is uniform in volume up to the bound.
        """
        step = z - center
        with np.errstate(divide="ignore"):
            reach = (1 - np.sign(step) * center) / np.abs(step)
        limit = reach[:, self.bounded].min(1, initial=np.inf)[:, None]
        place = limit * rng.random((len(z), 1)) ** (1 / self.dim)
        return np.where(limit < 1, center + place * step, z)

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

    def _forward(self, theta: Array) -> Array:
        with np.errstate(invalid="ignore", divide="ignore"):
            above, below = np.log(theta - self.low), np.log(self.high - theta)
        logarithm = np.where(self._side > 0, above, below)
        return np.where(self._side == 0, theta, logarithm)


def support_bounds(support: Any, dim: int) -> tuple[Array, Array]:
    """Return the bounds of each number of a torch constraint, shapes (dim,)."""
    if hasattr(support, "base_constraint"):
        return support_bounds(support.base_constraint, dim)
    if hasattr(support, "cseq"):  # constraints.cat
        parts = [
            support_bounds(part, int(length))
            for part, length in zip(support.cseq, support.lengths, strict=True)
        ]
        low, high = zip(*parts, strict=True)
        return np.concatenate(low), np.concatenate(high)
    bounds = []
    for name, missing in (("lower_bound", -np.inf), ("upper_bound", np.inf)):
        bound = torch.as_tensor(getattr(support, name, missing)).double().numpy()
        bounds.append(np.array(np.broadcast_to(bound.reshape(-1), (dim,))))
    return bounds[0], bounds[1]
