"""Weighted samples of a cheap density: annealed population Monte Carlo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from sbi_active.inference.sampling.eigen import eigh
from sbi_active.inference.sampling.student_mixture import (
    Defended,
    Proposal,
    log_student,
    student_steps,
)
from sbi_active.inference.sampling.tempering import largest_power
from sbi_active.inference.sampling.unbounding import Unbounding
from sbi_active.inference.sampling.weights import (
    effective_sample_size,
    normalized,
    systematic,
)

Array = NDArray[Any]

INFLATION = 1.4  # of the covariance of Student components
SHARE_OF_BASE = 0.1  # of every proposal, so that nothing is lost for good
SHARE_OF_STEP = 0.2  # particles that stay effective in a step
MAX_COMPONENTS = 12  # a choice: two are added where steps become short
MAX_STEPS = 40  # four times those that a peak of 1e-8 of the base's volume takes
NUM_FITTED = 800  # particles a mixture is fitted to, at least
FITTED = 8  # of them for each number in a covariance


@dataclass(frozen=True)
class Particles:
    r"""Draws :math:`z_i` from a proposal and their weights.

    Attributes:
        z: Shape (n, d).
        log_weight: Log of target over proposal, shape (n,).
        proposal: Where they were drawn.
    """

    z: Array
    log_weight: Array
    proposal: Proposal

    @property
    def weight(self) -> Array:
        """Normalized weights, shape (n,)."""
        return normalized(self.log_weight)

    @property
    def log_normalizer(self) -> float:
        r""":math:`\log \frac1n \sum_i w_i`."""
        return float(logsumexp(self.log_weight) - np.log(len(self.log_weight)))

    @property
    def effective_sample_size(self) -> float:
        r""":math:`(\sum w_i)^2 / \sum w_i^2`."""
        return effective_sample_size(self.log_weight)

    def resample(self, num_samples: int, rng: np.random.Generator) -> Array:
        """Return equally weighted particles, shape (n, d), by systematic resampling."""
        return self.z[systematic(self.weight, num_samples, rng.random())]


@dataclass(frozen=True)
class GaussianMixture:
    """Gaussian mixture with full covariances.

    Attributes:
        log_weight: Shape (k,).
        mean: Shape (k, d).
        factor: Lower Cholesky factors, shape (k, d, d).
        log_likelihood: Of the points it was fitted to, a point.
    """

    log_weight: Array
    mean: Array
    factor: Array
    log_likelihood: float

    @staticmethod
    def fit(
        points: Array,
        num_components: int,
        rng: np.random.Generator,
        *,
        num_iterations: int = 25,
    ) -> GaussianMixture:
        """Fit by expectation-maximization from seeds spread over points (n, d).

        Repeated points count as often as they occur; where points are few, components
        are fewer.
        """
        center = points.mean(0)
        # A relative floor: a cluster may be 1e-5 of the cloud wide, or one point.
        spread = points.std(0) + 1e-12 * (np.abs(center) + 1.0)
        covariance = np.cov(((points - center) / spread).T, bias=True)
        root = np.linalg.cholesky(
            np.atleast_2d(covariance) + 1e-12 * np.eye(len(spread))
        )
        whitening = spread[:, None] * root
        z = np.linalg.solve(whitening, (points - center).T).T
        n, d = z.shape
        k = max(1, min(num_components, n // max(2 * d + 2, _num_moments(d))))
        share = _spread_responsibility(z, k, rng)
        previous = -np.inf
        for _ in range(num_iterations if k > 1 else 1):
            count = share.sum(0) + 1e-12
            mean = (share.T @ z) / count[:, None]
            second = (share.T[:, None] * z.T) @ z
            covariance = (
                second / count[:, None, None] - mean[:, :, None] * mean[:, None]
            )
            floor = 1e-9 + 1e-6 * (count < d + 1)[:, None, None]
            factor = np.linalg.cholesky(_positive(covariance) + floor * np.eye(d))
            log_weight = np.log(count / count.sum())
            joint = log_weight + _gaussian_log_prob(z, mean, factor)
            total = np.asarray(logsumexp(joint, axis=1))
            share = np.exp(joint - total[:, None])
            if total.mean() - previous < 1e-3:
                break
            previous = total.mean()
        log_volume = np.log(np.diag(whitening)).sum()
        return GaussianMixture(
            log_weight,
            mean @ whitening.T + center,
            whitening @ factor,
            float(total.mean() - log_volume),
        )

    def log_prob(self, points: Array) -> Array:
        """Return log densities, shape (n,)."""
        joint = self.log_weight + _gaussian_log_prob(points, self.mean, self.factor)
        return np.asarray(logsumexp(joint, axis=1))

    def assign(self, points: Array) -> NDArray[np.intp]:
        """Return the likeliest component of each point, shape (n,)."""
        joint = self.log_weight + _gaussian_log_prob(points, self.mean, self.factor)
        return joint.argmax(1)


@dataclass(frozen=True)
class WidenedMixture:
    """Student components over fitted Gaussian ones, none of them of little weight.

    Attributes:
        mixture: The Gaussian components.
        unbounding: Where they were fitted; None is in z itself.
    """

    mixture: GaussianMixture
    unbounding: Unbounding | None = None

    @property
    def weight(self) -> Array:
        """Of the components, shape (k,)."""
        k = len(self.mixture.log_weight)
        return 0.8 * np.exp(self.mixture.log_weight) + 0.2 / k

    @property
    def factor(self) -> Array:
        """Lower Cholesky factors, shape (k, d, d)."""
        return INFLATION**0.5 * self.mixture.factor

    def sample(self, num_samples: int, rng: np.random.Generator) -> Array:
        """Return draws, shape (n, d)."""
        mean = self.mixture.mean
        count = rng.multinomial(num_samples, self.weight)
        steps = student_steps(num_samples, mean.shape[1], rng)
        parts = np.split(steps, np.cumsum(count)[:-1])
        triples = zip(mean, self.factor, parts, strict=True)
        drawn = np.concatenate([m + part @ factor.T for m, factor, part in triples])
        return drawn if self.unbounding is None else self.unbounding.from_line(drawn)

    def log_prob(self, z: Array) -> Array:
        """Return the log density, (n, d) -> (n,)."""
        y = z if self.unbounding is None else self.unbounding.to_line(z)
        square, log_volume = _mahalanobis(y, self.mixture.mean, self.factor)
        each = log_student(square, log_volume, z.shape[1]) + np.log(self.weight)
        density = np.asarray(logsumexp(each, axis=1))
        slope = 0.0 if self.unbounding is None else self.unbounding.log_slope(y)
        return density + slope


class StudentProposal(Defended):
    """Student mixture over fitted Gaussian components, with a share of a base.

    Where there is an unbounding, the components were fitted on its line.
    """

    def __init__(
        self,
        mixture: GaussianMixture,
        base: Proposal,
        unbounding: Unbounding | None = None,
    ) -> None:
        super().__init__(WidenedMixture(mixture, unbounding), base, SHARE_OF_BASE)

    @staticmethod
    def fit(
        points: Array,
        num_components: int,
        base: Proposal,
        rng: np.random.Generator,
        unbounding: Unbounding | None = None,
    ) -> StudentProposal:
        """Fit components to points, shape (n, d)."""
        places = points if unbounding is None else unbounding.to_line(points)
        mixture = GaussianMixture.fit(places, num_components, rng)
        return StudentProposal(mixture, base, unbounding)


def population_monte_carlo(
    log_density: Callable[[Array], Array],
    base: Proposal,
    rng: np.random.Generator,
    *,
    num_particles: int,
    first: Proposal | None = None,
    num_components: int = 6,
    unbounding: Unbounding | None = None,
) -> tuple[Particles, int]:
    r"""Sample a density by importance sampling from mixtures fitted to it.

    The target is reached from the base along

    .. math::
        \pi_\beta(z) \propto g_0(z)^{1 - \beta}\, \pi(z)^\beta,

    each step as long as a fifth of the particles stays effective, so that a peak
    :math:`10^{-8}` of the base's volume is found in some ten steps.

    Args:
        log_density: Log of the unnormalized :math:`\pi`, (n, d) -> (n,); -inf allowed.
        base: :math:`g_0`, which should cover the target.
        rng: Source of randomness.
        num_particles: At the last steps; half as many on the way.
        first: A guess at the target to begin with; None begins at the base.
        num_components: Of the fitted mixtures.
        unbounding: Where mixtures are fitted; None is in z itself.

    Returns:
        The particles of the last step and the number of steps.

    References:
        Cappe et al., J. Comp. Graph. Stat. 2004; Neal, Stat. Comput. 2001.
    """
    beta, at_target, share = 0.0, 0, SHARE_OF_STEP
    proposal = base if first is None else first
    best: Particles | None = None
    for step in range(MAX_STEPS):
        num = num_particles if beta == 1 or step == 0 else num_particles // 2
        z = proposal.sample(num, rng)
        log_q = proposal.log_prob(z)
        log_target = log_density(z)
        particles = Particles(z, log_target - log_q, proposal)
        ess = particles.effective_sample_size / num
        if beta == 1:
            at_target += 1
            if best is None or ess * num > best.effective_sample_size:
                best = particles
            if ess > 0.4 or (at_target >= 3 and ess > 0.2) or at_target >= 6:
                break
        log_base = log_q if proposal is base else base.log_prob(z)
        reached = beta
        beta = _next_beta(log_base, log_target, log_q, beta, share)
        if 0 < beta < 1 and beta < 1.1 * reached:
            # More peaks than components: fit more of them, and take a coarser step.
            num_components = min(num_components + 2, MAX_COMPONENTS)
            share = max(0.7 * share, 0.02)
        tempered = _tempered(log_base, log_target, log_q, beta)
        weight = normalized(tempered)
        num_fitted = max(NUM_FITTED, FITTED * _num_moments(z.shape[1]))
        points = z[systematic(weight, num_fitted, rng.random())]
        proposal = StudentProposal.fit(points, num_components, base, rng, unbounding)
    return (particles if best is None else best), step + 1


def _num_moments(dim: int) -> int:
    """Return the numbers in a mean and a covariance."""
    return dim * (dim + 3) // 2


def _tempered(log_base: Array, log_target: Array, log_q: Array, beta: float) -> Array:
    with np.errstate(invalid="ignore"):
        tempered = (1 - beta) * log_base + beta * log_target - log_q
    return np.where(np.isfinite(log_target) & np.isfinite(tempered), tempered, -np.inf)


def _next_beta(
    log_base: Array, log_target: Array, log_q: Array, beta: float, share: float
) -> float:
    """Return the largest step that leaves a share of the particles effective."""

    def suffices(candidate: float) -> bool:
        log_weight = _tempered(log_base, log_target, log_q, candidate)
        return effective_sample_size(log_weight) > share * len(log_weight)

    return largest_power(suffices, start=beta, num_steps=25)


def _spread_responsibility(z: Array, k: int, rng: np.random.Generator) -> Array:
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


def _positive(covariance: Array) -> Array:
    """Return the nearest positive semi-definite matrices; rounding leaves -1e-16."""
    value, vector = eigh(covariance)
    return (vector * np.maximum(value, 0.0)[:, None]) @ np.swapaxes(vector, -1, -2)


def _mahalanobis(z: Array, mean: Array, factor: Array) -> tuple[Array, Array]:
    """Return squared distances, shape (n, k), and log volumes, shape (k,)."""
    inverse = np.linalg.inv(factor)
    square = np.stack(
        [(((z - m) @ i.T) ** 2).sum(1) for m, i in zip(mean, inverse, strict=True)], 1
    )
    return square, np.log(np.abs(np.diagonal(factor, axis1=1, axis2=2))).sum(1)


def _gaussian_log_prob(z: Array, mean: Array, factor: Array) -> Array:
    square, log_volume = _mahalanobis(z, mean, factor)
    return -0.5 * (square + z.shape[1] * np.log(2 * np.pi)) - log_volume
