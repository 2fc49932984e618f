"""A posterior by least squares and importance sampling, as an expert would do it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import expit, gammaln, logit, logsumexp
from sklearn.mixture import GaussianMixture

from benchmarks.flag.problems import Problem

Array = NDArray[Any]

STARTS, NUM_DRAWS, ROUNDS = 12, 12_000, 5
DF = 6.0  # of the Student proposals
EDGE = 1e-9


@dataclass(frozen=True)
class Reference:
    """A weighted sample of the posterior.

    Attributes:
        theta: Shape (n, d).
        weight: Sums to one, shape (n,).
    """

    theta: Array
    weight: Array

    @property
    def effective_sample_size(self) -> float:
        """Kish's effective sample size."""
        return float(1 / (self.weight**2).sum())

    def compare(self, draws: Array) -> tuple[float, float]:
        """Return the KL divergence of normal fits, nats, and the largest shift, sd."""
        mean = self.weight @ self.theta
        cov = np.cov(self.theta.T, aweights=self.weight)
        other = np.cov(draws.T) + 1e-12 * np.eye(len(mean))
        gap = draws.mean(0) - mean
        inverse = np.linalg.inv(other)
        volume = np.linalg.slogdet(other)[1] - np.linalg.slogdet(cov)[1]
        divergence = np.trace(inverse @ cov) + gap @ inverse @ gap - len(mean) + volume
        return float(divergence / 2), float(np.abs(gap / np.sqrt(np.diag(cov))).max())


def reference_of(problem: Problem, draws: Array) -> Reference:
    """Return the best weighted sample of a few rounds.

    Args:
        problem: Gives prior and likelihood.
        draws: Of a belief to compare, shape (n, d): what it found is looked at as well.
    """
    rng = np.random.default_rng([problem.dim, problem.seed, 7])
    best: Any = None
    for _ in range(STARTS):
        start = rng.uniform(-0.9, 0.9, problem.dim)
        fit = least_squares(
            lambda t: problem.residual(t[None])[0], start, bounds=(-1, 1), max_nfev=60
        )
        best = fit if best is None or fit.cost < best.cost else best
    precision = best.jac.T @ best.jac + 3 * np.eye(problem.dim)
    normal = rng.multivariate_normal(best.x, np.linalg.inv(precision), 2_000)
    y = _to_line(np.concatenate([normal, draws[:2_000]]))
    found: Reference | None = None
    for k in range(ROUNDS):
        mixture = _Student(y, 3 if k == 0 else 4, 1.6 if k == 0 else 1.2)
        y = mixture.sample(NUM_DRAWS, rng)
        theta = 2 * expit(y) - 1
        square = (problem.residual(theta) ** 2).sum(1)
        log_slope = np.log(2 * expit(y) * expit(-y)).sum(1)
        log_weight = log_slope - 0.5 * square - mixture.log_prob(y)
        weight = np.exp(log_weight - logsumexp(log_weight))
        sample = Reference(theta, weight)
        if found is None or sample.effective_sample_size > found.effective_sample_size:
            found = sample
        y = y[rng.choice(len(y), 4_000, p=weight)]
        y = y + 1e-3 * rng.standard_normal(y.shape)
    assert found is not None
    return found


def _to_line(theta: Array) -> Array:
    return logit(np.clip((theta + 1) / 2, EDGE, 1 - EDGE))


class _Student:
    """A mixture of Student t distributions, fitted to draws."""

    def __init__(self, y: Array, num_components: int, wider: float) -> None:
        fit = GaussianMixture(num_components, reg_covar=1e-6, random_state=0).fit(y)
        self.weight, self.mean = fit.weights_, fit.means_
        self.factor = np.linalg.cholesky(wider * fit.covariances_)

    def sample(self, num: int, rng: np.random.Generator) -> Array:
        """Return draws, shape (n, d)."""
        which = rng.choice(len(self.weight), num, p=self.weight)
        normal = rng.standard_normal((num, self.mean.shape[1]))
        step = np.einsum("nij,nj->ni", self.factor[which], normal)
        return self.mean[which] + step * np.sqrt(DF / rng.chisquare(DF, num))[:, None]

    def log_prob(self, y: Array) -> Array:
        """Return log densities, shape (n,)."""
        d, parts = y.shape[1], []
        for weight, mean, factor in zip(
            self.weight, self.mean, self.factor, strict=True
        ):
            square = (np.linalg.solve(factor, (y - mean).T) ** 2).sum(0)
            size = gammaln((DF + d) / 2) - gammaln(DF / 2) - d / 2 * np.log(DF * np.pi)
            size = size - np.log(np.diag(factor)).sum() + np.log(weight)
            parts.append(size - (DF + d) / 2 * np.log1p(square / DF))
        return logsumexp(parts, axis=0)
