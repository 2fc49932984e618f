"""Normal and t distributions: mixtures, draws between bounds, and fits to points."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.special import gammaln, log_ndtr, ndtr, ndtri
from typing_extensions import override

from sbi_active.arrays import Array
from sbi_active.inference.sampling.weights import log_sum_exp, systematic


def eigh(matrix: Array) -> tuple[Array, Array]:
    """Return eigenvalues, smallest first, and eigenvectors, as ``numpy.linalg.eigh``.

    The divide and conquer of LAPACK that NumPy calls fails, with some builds, on good
    matrices of which many eigenvalues are equal. Relatively robust representations find
    these as well.

    Args:
        matrix: Symmetric, shape (..., n, n).

    Returns:
        Shapes (..., n) and (..., n, n).

    Raises:
        numpy.linalg.LinAlgError: If neither converges, as where it is not finite.

    References:
        Dhillon, Parlett and Voemel, ACM Trans. Math. Software 32 (2006).
    """
    try:
        return np.linalg.eigh(matrix)
    except np.linalg.LinAlgError:
        if not np.isfinite(matrix).all():
            raise
        stack = matrix.reshape(-1, *matrix.shape[-2:])
        found = [scipy.linalg.eigh(one, driver="evr") for one in stack]
    values = np.stack([value for value, _ in found])
    vectors = np.stack([vector for _, vector in found])
    return values.reshape(matrix.shape[:-1]), vectors.reshape(matrix.shape)


class Proposal(Protocol):
    """A density that can be sampled.

    Attributes:
        error: Standard error of its log density, nats, where its mass was estimated.
    """

    error: float = 0.0

    def sample(self, num_samples: int, rng: np.random.Generator) -> Array:
        """Return draws, shape (n, d)."""
        ...

    def log_prob(self, z: Array) -> Array:
        """Return log densities, shape (n,)."""
        ...


def log_student(square: Array, log_volume: Array, dim: int, freedom: float) -> Array:
    r"""Return log densities of multivariate t distributions.

    .. math::
        \log \Gamma\big(\tfrac{\nu + d}{2}\big) - \log \Gamma\big(\tfrac{\nu}{2}\big)
        - \tfrac d2 \log \pi \nu - \log |L|
        - \tfrac{\nu + d}{2} \log\big(1 + \|L^{-1} (z - m)\|^2 / \nu\big)

    Args:
        square: :math:`\|L^{-1} (z - m)\|^2`, any shape.
        log_volume: :math:`\log |L|`, a shape that broadcasts with it.
        dim: d.
        freedom: Degrees of freedom, :math:`\nu`; infinite is a normal distribution.
    """
    if np.isinf(freedom):
        return -0.5 * (square + dim * np.log(2 * np.pi)) - log_volume
    constant = (
        gammaln(0.5 * (freedom + dim))
        - gammaln(0.5 * freedom)
        - 0.5 * dim * np.log(np.pi * freedom)
    )
    tail = 0.5 * (freedom + dim) * np.log1p(square / freedom)
    return constant - log_volume - tail


@dataclass(frozen=True)
class StudentMixture(Proposal):
    r"""Mixture of t or normal distributions, whose widths may differ by side.

    With e of a t distribution of unit scale,

    .. math::
        u = m + A\, (s \odot e), \qquad s_i = r_i \text{ if } e_i > 0,
        \text{ else } l_i,

    which is piecewise linear: its density is that of e over
    :math:`|A| \prod_i s_i`.

    Attributes:
        means: m, shape (k, d).
        factors: A, shape (k, d, d): lower Cholesky factors of the scale matrices, or
            axes of unit scale.
        weights: Sum to 1, shape (k,); none are equal ones.
        freedom: Degrees of freedom; infinite has normal components. Five have tails
            above any Gaussian's, and a covariance that exists.
        left: l, shape (k, d); None is 1.
        right: r, likewise.

    References:
        Geweke, Econometrica 57 (1989).
    """

    means: Array
    factors: Array
    weights: Array = field(default_factory=lambda: np.zeros(0))
    freedom: float = 5.0
    left: Array | None = None
    right: Array | None = None

    def __post_init__(self) -> None:
        if not len(self.weights):
            k = len(self.means)
            object.__setattr__(self, "weights", np.full(k, 1 / k))

    @override
    def sample(self, num_samples: int, rng: np.random.Generator) -> Array:
        steps = rng.standard_normal((num_samples, self.means.shape[1]))
        if np.isfinite(self.freedom):
            square = rng.chisquare(self.freedom, (num_samples, 1)) / self.freedom
            steps /= np.sqrt(square)
        return self.moved(self.components(num_samples, rng), steps)

    def components(self, num: int, rng: np.random.Generator) -> NDArray[np.int64]:
        """Return the component of each draw, in proportion to the weights, (num,)."""
        return systematic(self.weights, num, rng.random())

    def moved(self, which: NDArray[np.int64], steps: Array) -> Array:
        """Return steps of unit scale, shape (n, d), from the components (n,)."""
        if self.left is not None and self.right is not None:
            steps = steps * np.where(steps > 0, self.right[which], self.left[which])
        return self.means[which] + np.einsum("nij,nj->ni", self.factors[which], steps)

    @override
    def log_prob(self, z: Array) -> Array:
        parts = [log_sum_exp(self.log_parts(z[at]), axis=0) for at in self._blocks(z)]
        return np.concatenate(parts)

    def shares(self, z: Array, weight: Array) -> Array:
        """Return the part of weights (n,) of places z that each component has, (k,)."""
        total = np.zeros(len(self.means))
        for at in self._blocks(z):
            parts = self.log_parts(z[at])
            total += np.exp(parts - log_sum_exp(parts, axis=0)) @ weight[at]
        return total

    def _blocks(self, z: Array, *, most: int = 100_000) -> list[NDArray[np.intp]]:
        # Hundreds of components by thousands of draws are more than memory holds: so
        # many numbers at a time.
        num = 1 + self.means.size * len(z) // most
        return np.array_split(np.arange(len(z)), num)

    def log_parts(self, z: Array) -> Array:
        """Return log of weight times density of each component, shape (k, n)."""
        apart = (z - self.means[:, None]).transpose(0, 2, 1)
        inverse, log_volume = self._inverted
        step, log_volume = inverse @ apart, log_volume[:, None]  # (k, d, n)
        if self.left is not None and self.right is not None:
            scale = np.where(step > 0, self.right[..., None], self.left[..., None])
            step, log_volume = step / scale, log_volume + np.log(scale).sum(1)
        square = (step**2).sum(1)
        return log_student(square, log_volume, z.shape[1], self.freedom)

    @cached_property
    def _inverted(self) -> tuple[Array, Array]:
        """Inverses of the factors, and their log determinants over the weights."""
        log_volume = np.linalg.slogdet(self.factors)[1] - np.log(self.weights)
        return np.linalg.inv(self.factors), log_volume


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


def fitted_normals(
    points: Array,
    num_components: int,
    rng: np.random.Generator,
    *,
    num_iterations: int = 25,
    num_starts: int = 4,
    clearly: float = 1.0,
) -> StudentMixture:
    """Return normal components, fitted by expectation-maximization to points (n, d).

    They begin at seeds spread over the points. Repeated points count as often as they
    occur; where points are few, components are fewer.

    Args:
        points: The points.
        num_components: Number of components at most.
        rng: Source of the seeds.
        num_iterations: Number of steps at most.
        num_starts: Number of sets of seeds. Of one set components lay across two thin
            modes for good in one of two hundred posteriors, of two in none.
        clearly: Nats a point by which another set than the first has to be likelier;
            thin modes are told by 3 to 8, and half and twice this choose the same.
    """
    center = points.mean(0)
    # A relative floor: a cluster may be 1e-5 of the cloud wide, or one point.
    spread = points.std(0) + 1e-12 * (np.abs(center) + 1.0)
    covariance = np.cov(((points - center) / spread).T, bias=True)
    root = np.linalg.cholesky(np.atleast_2d(covariance) + 1e-12 * np.eye(len(spread)))
    whitening = spread[:, None] * root
    z = np.linalg.solve(whitening, (points - center).T).T
    n, d = z.shape
    num_moments = d * (d + 3) // 2  # of a mean and a covariance
    k = max(1, min(num_components, n // max(2 * d + 2, num_moments)))
    if k == 1:
        num_iterations = num_starts = 1
    mixture, total, share = _maximized(z, _nearest_seed(z, k, rng))
    further = np.random.default_rng(0)  # the seeds of the first are those of one alone
    for _ in range(num_starts - 1):
        other = _maximized(z, _nearest_seed(z, k, further))
        # A component of a few points is likely for them alone.
        is_whole = other[0].weights.min() * n > d + 1
        if is_whole and other[1].mean() > total.mean() + clearly:
            mixture, total, share = other
    for _ in range(num_iterations - 1):
        previous = total.mean()
        mixture, total, share = _maximized(z, share)
        if total.mean() - previous < 1e-3:
            break
    return replace(
        mixture,
        means=mixture.means @ whitening.T + center,
        factors=whitening @ mixture.factors,
    )


def _maximized(z: Array, share: Array) -> tuple[StudentMixture, Array, Array]:
    """Return the likeliest normals of responsibilities for points, shape (n, k).

    Beside them are the log densities of the points, (n,), and new responsibilities.
    """
    count = share.sum(0) + 1e-12
    mean = (share.T @ z) / count[:, None]
    second = (share.T[:, None] * z.T) @ z
    covariance = second / count[:, None, None] - mean[:, :, None] * mean[:, None]
    d = z.shape[1]
    floor = 1e-9 + 1e-6 * (count < d + 1)[:, None, None]
    factor = lower_factors(covariance + floor * np.eye(d))
    mixture = StudentMixture(mean, factor, count / count.sum(), np.inf)
    joint = mixture.log_parts(z).T
    total = log_sum_exp(joint, axis=1)
    return mixture, total, np.exp(joint - total[:, None])


def _nearest_seed(z: Array, k: int, rng: np.random.Generator) -> Array:
    """Return each point's nearest seed, the seeds far apart, shape (n, k)."""
    seeds = z[[rng.integers(len(z))]]
    square = ((z - seeds) ** 2).sum(1)
    for _ in range(k - 1):
        total = square.sum()
        pick = rng.choice(len(z), p=square / total) if total > 0 else 0
        seeds = np.concatenate([seeds, z[[pick]]])
        square = np.minimum(square, ((z - z[pick]) ** 2).sum(1))
    distance = ((z[:, None] - seeds) ** 2).sum(-1)
    return np.eye(k)[distance.argmin(1)]


def wider(factor: float, dim: int) -> float:
    """Return the factor of widths in more dimensions that costs as many draws."""
    return (1 + (factor**2 - 1) / dim**0.5) ** 0.5


def log_inside(mean: Array, sd: Array, low: Array, high: Array) -> Array:
    """Return the log probability of a normal variable between bounds."""
    a, b = _lower_tail((low - mean) / sd, (high - mean) / sd)[:2]
    upper, lower = log_ndtr(b), log_ndtr(a)
    return upper + np.log1p(-np.exp(np.minimum(lower - upper, -1e-12)))


def truncated_normal(
    mean: Array, sd: Array, low: Array, high: Array, rng: np.random.Generator
) -> Array:
    """Return normal draws between bounds, all of shape (n,)."""
    a, b, flip = _lower_tail((low - mean) / sd, (high - mean) / sd)
    share = ndtr(a) + (ndtr(b) - ndtr(a)) * rng.random(len(mean))
    z = np.clip(ndtri(np.clip(share, 1e-300, 1 - 1e-16)), a, b)
    return mean + sd * np.where(flip, -z, z)


def draws_between(
    mean: Array, cov: Array, low: Array, high: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return normal draws between bounds, (n, d), and their log weights, (n,).

    One coordinate is drawn after the other, those first that the bounds cut most. The
    weight is the probability that each is within its bounds given those before, over
    what it is were they independent.

    Args:
        mean: Mean of each draw, shape (n, d).
        cov: Covariance of each draw, shape (n, d, d).
        low: Lower bounds, shape (d,).
        high: Upper bounds, shape (d,).
        rng: Source of the draws.

    References:
        Hajivassiliou & McFadden, Econometrica 66 (1998), on the simulator of Geweke,
        Hajivassiliou and Keane.
    """
    sd = np.sqrt(np.einsum("nii->ni", cov))
    alone = log_inside(mean, sd, low, high)
    order = np.argsort(alone.sum(0), kind="stable")
    root = lower_factors(cov[:, order[:, None], order])
    z, u, log_weight = np.zeros_like(mean), np.empty_like(mean), -alone.sum(1)
    for i, j in enumerate(order):
        center = mean[:, j] + (root[:, i, :i] * z[:, :i]).sum(1)
        own = root[:, i, i]
        u[:, j] = truncated_normal(center, own, low[j], high[j], rng)
        log_weight += log_inside(center, own, low[j], high[j])
        z[:, i] = (u[:, j] - center) / own
    return u, log_weight


def _lower_tail(a: Array, b: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return two quantiles mirrored to the lower tail, where small shares are exact."""
    with np.errstate(invalid="ignore"):
        flip = a + b > 0
    return np.where(flip, -b, a), np.where(flip, -a, b), flip
