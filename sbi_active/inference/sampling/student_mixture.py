"""Student-t densities, mixtures of them, and mixtures that defend themselves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln
from typing_extensions import override

from sbi_active.inference.sampling.eigen import eigh
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


def log_student(
    square: Array, log_volume: Array, dim: int, freedom: float = FREEDOM
) -> Array:
    r"""Return log densities of multivariate t distributions.

    .. math::
        \log \Gamma\big(\tfrac{\nu + d}{2}\big) - \log \Gamma\big(\tfrac{\nu}{2}\big)
        - \tfrac d2 \log \pi \nu - \log |L|
        - \tfrac{\nu + d}{2} \log\big(1 + \|L^{-1} (z - m)\|^2 / \nu\big)

    Args:
        square: :math:`\|L^{-1} (z - m)\|^2`, any shape.
        log_volume: :math:`\log |L|`, a shape that broadcasts with it.
        dim: d.
        freedom: Degrees of freedom, :math:`\nu`.
    """
    constant = (
        gammaln(0.5 * (freedom + dim))
        - gammaln(0.5 * freedom)
        - 0.5 * dim * np.log(np.pi * freedom)
    )
    tail = 0.5 * (freedom + dim) * np.log1p(square / freedom)
    return constant - log_volume - tail


@dataclass(frozen=True)
class StudentMixture:
    """Mixture of multivariate t distributions.

    Attributes:
        means: Means of the components, shape (k, dim).
        factors: Lower Cholesky factors of the scale matrices, shape (k, dim, dim).
        weights: Sum to 1, shape (k,); None has equal ones.
        freedom: Degrees of freedom.
    """

    means: Array
    factors: Array
    weights: Array | None = None
    freedom: float = FREEDOM

    def sample(self, num_samples: int, rng: np.random.Generator) -> Array:
        """Return draws, shape (n, dim), each component's share of them fixed."""
        normal = rng.normal(size=(num_samples, self.means.shape[1]))
        square = rng.chisquare(self.freedom, size=(num_samples, 1)) / self.freedom
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
        square = ((np.linalg.inv(self.factors) @ apart) ** 2).sum(1)
        log_volume = np.log(np.diagonal(self.factors, axis1=1, axis2=2)).sum(1)
        log_volume = (log_volume - np.log(weights))[:, None]
        return log_student(square, log_volume, z.shape[1], self.freedom)


@dataclass(frozen=True)
class SplitStudentMixture(Proposal):
    r"""Mixture of t distributions whose widths differ from side to side.

    With e of a t distribution of unit scale,

    .. math::
        u = m + A\, (s \odot e), \qquad s_i = r_i \text{ if } e_i > 0,
        \text{ else } l_i,

    which is piecewise linear: its density is that of e over
    :math:`|A| \prod_i s_i`.

    Attributes:
        means: m, shape (k, d).
        axes: A, whose columns are axes of unit scale, shape (k, d, d).
        left: l, shape (k, d).
        right: r, shape (k, d).
        weights: Sum to 1, shape (k,).
        freedom: Degrees of freedom.

    References:
        Geweke, Econometrica 57 (1989).
    """

    means: Array
    axes: Array
    left: Array
    right: Array
    weights: Array
    freedom: float = FREEDOM

    def sample(self, num_samples: int, rng: np.random.Generator) -> Array:
        """Return draws, shape (n, d)."""
        which = systematic(self.weights, num_samples, rng.random())
        normal = rng.standard_normal((num_samples, self.means.shape[1]))
        square = rng.chisquare(self.freedom, (num_samples, 1)) / self.freedom
        e = normal / np.sqrt(square)
        step = e * np.where(e > 0, self.right[which], self.left[which])
        return self.means[which] + np.einsum("nij,nj->ni", self.axes[which], step)

    def log_prob(self, z: Array) -> Array:
        """Return log densities, shape (n,)."""
        apart = (z - self.means[:, None]).transpose(0, 2, 1)
        step = np.linalg.inv(self.axes) @ apart  # (k, d, n)
        scale = np.where(step > 0, self.right[..., None], self.left[..., None])
        volume = np.linalg.slogdet(self.axes)[1][:, None] + np.log(scale).sum(1)
        volume = volume - np.log(self.weights)[:, None]
        square = ((step / scale) ** 2).sum(1)
        parts = log_student(square, volume, z.shape[1], self.freedom)
        return log_sum_exp(parts, axis=0)


@dataclass(frozen=True)
class NormalMixture(Proposal):
    """Normal components.

    Attributes:
        weights: Sum to 1, shape (k,).
        means: Means of the components, shape (k, d).
        factors: Lower Cholesky factors, shape (k, d, d).
    """

    weights: Array
    means: Array
    factors: Array

    def sample(self, num_samples: int, rng: np.random.Generator) -> Array:
        """Return draws, shape (n, d)."""
        which = systematic(self.weights, num_samples, rng.random())
        step = rng.standard_normal((num_samples, self.means.shape[1]))
        return self.means[which] + np.einsum("nij,nj->ni", self.factors[which], step)

    def log_prob(self, z: Array) -> Array:
        """Return log densities, shape (n,)."""
        parts = [
            np.log(w) + log_normal(z, mean, factor)
            for w, mean, factor in zip(
                self.weights, self.means, self.factors, strict=True
            )
        ]
        return log_sum_exp(np.stack(parts), axis=0)


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


def lower_factors(cov: Array, *, singular: float = 1e-12) -> Array:
    """Return lower Cholesky factors of covariances, shape (..., dim, dim).

    A covariance that is singular in floating point, as if a few trials determine many
    digits, has its smallest variances raised to 1e-12 of the largest.
    """
    try:
        return np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        pass
    safe = np.where(np.isfinite(cov).all((-1, -2), keepdims=True), cov, 0.0)
    values, vectors = eigh(0.5 * (safe + np.swapaxes(safe, -1, -2)))
    least = np.maximum(singular * values[..., -1:], singular**2)
    root = vectors * np.sqrt(np.maximum(values, least))[..., None, :]
    upper = np.linalg.qr(np.swapaxes(root, -1, -2), mode="r")
    sign = np.where(np.diagonal(upper, axis1=-2, axis2=-1) < 0, -1.0, 1.0)
    return np.swapaxes(upper * sign[..., None], -1, -2)


def log_normal(z: Array, mean: Array, factor: Array) -> Array:
    """Return log normal densities, shape (n,), of places (n, d)."""
    step = np.linalg.solve(factor, (z - mean).T)
    volume = np.log(np.diag(factor)).sum() + 0.5 * len(mean) * np.log(2 * np.pi)
    return -0.5 * (step**2).sum(0) - volume
