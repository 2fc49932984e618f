"""Student-t densities, mixtures of them, and mixtures that defend themselves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln
from typing_extensions import override

from sbi_active.inference.sampling.weights import log_sum_exp, systematic

Array = NDArray[Any]

#: Degrees of freedom: tails above any Gaussian's, and a covariance that exists.
FREEDOM = 5.0


class Proposal(Protocol):
    """A density that can be sampled."""

    def sample(self, num_samples: int, rng: np.random.Generator) -> Array:
        """Return draws, shape (n, d)."""
        ...

    def log_prob(self, z: Array) -> Array:
        """Return log densities, shape (n,)."""
        ...


def log_student(square: Array, log_volume: Array, dim: int) -> Array:
    r"""Return log densities of multivariate t distributions of 5 degrees of freedom.

    .. math::
        \log \Gamma\big(\tfrac{\nu + d}{2}\big) - \log \Gamma\big(\tfrac{\nu}{2}\big)
        - \tfrac d2 \log \pi \nu - \log |L|
        - \tfrac{\nu + d}{2} \log\big(1 + \|L^{-1} (z - m)\|^2 / \nu\big)

    Args:
        square: :math:`\|L^{-1} (z - m)\|^2`, any shape.
        log_volume: :math:`\log |L|`, a shape that broadcasts with it.
        dim: d.
    """
    constant = (
        gammaln(0.5 * (FREEDOM + dim))
        - gammaln(0.5 * FREEDOM)
        - 0.5 * dim * np.log(np.pi * FREEDOM)
    )
    tail = 0.5 * (FREEDOM + dim) * np.log1p(square / FREEDOM)
    return constant - log_volume - tail


def student_steps(num: int, dim: int, rng: np.random.Generator) -> Array:
    """Return draws of a t distribution of unit scale, shape (num, dim)."""
    scale = np.sqrt(FREEDOM / rng.chisquare(FREEDOM, (num, 1)))
    return scale * rng.standard_normal((num, dim))


@dataclass(frozen=True)
class StudentMixture:
    """Mixture of multivariate t distributions.

    Attributes:
        means: Shape (k, dim).
        factors: Lower Cholesky factors of the scale matrices, shape (k, dim, dim).
        weights: Sum to 1, shape (k,); None has equal ones.
    """

    means: Array
    factors: Array
    weights: Array | None = None

    def sample(self, num_samples: int, rng: np.random.Generator) -> Array:
        """Return draws, shape (n, dim), each component's share of them fixed."""
        normal = rng.normal(size=(num_samples, self.means.shape[1]))
        square = rng.chisquare(FREEDOM, size=(num_samples, 1)) / FREEDOM
        return self.moved(self.components(num_samples), normal / np.sqrt(square))

    def components(self, num: int) -> NDArray[np.int64]:
        """Return the component of each draw, in proportion to the weights, (num,)."""
        if self.weights is None:
            return np.arange(num) % len(self.means)
        return systematic(self.weights, num, 0.5)

    def moved(self, which: NDArray[np.int64], steps: Array) -> Array:
        """Return steps of unit scale, shape (n, dim), from the components (n,)."""
        return self.means[which] + np.einsum("nij,nj->ni", self.factors[which], steps)

    def log_prob(self, z: Array) -> Array:
        """Return log densities, shape (n,)."""
        return log_sum_exp(self.log_parts(z), axis=0)

    def log_parts(self, z: Array) -> Array:
        """Return log of weight times density of each component, shape (k, n)."""
        k = len(self.means)
        weights = np.full(k, 1 / k) if self.weights is None else self.weights
        apart = (z - self.means[:, None]).transpose(0, 2, 1)
        square = (np.linalg.solve(self.factors, apart) ** 2).sum(1)
        log_volume = np.log(np.diagonal(self.factors, axis1=1, axis2=2)).sum(1)
        return log_student(square, (log_volume - np.log(weights))[:, None], z.shape[1])


@dataclass(frozen=True)
class Defended(Proposal):
    r"""A proposal with a share of another that covers the target.

    .. math::
        g(z) = (1 - \epsilon)\, g_1(z) + \epsilon\, g_0(z)

    Attributes:
        main: :math:`g_1`.
        base: :math:`g_0`.
        share: :math:`\epsilon`; no weight exceeds that under the base by more than
            its inverse.

    References:
        Hesterberg, Technometrics 37 (1995).
    """

    main: Proposal
    base: Proposal
    share: float

    @override
    def sample(self, num_samples: int, rng: np.random.Generator) -> Array:
        num_base = rng.binomial(num_samples, self.share)
        drawn = self.main.sample(num_samples - num_base, rng)
        return np.concatenate([drawn, self.base.sample(num_base, rng)])

    @override
    def log_prob(self, z: Array) -> Array:
        return np.logaddexp(
            np.log1p(-self.share) + self.main.log_prob(z),
            np.log(self.share) + self.base.log_prob(z),
        )
