r"""The likelihood of a trial, learned from simulations at its action.

With declared noise the noise-free outcome f is interpolated,

.. math::
    p(x | \theta) = \mathcal N\big(x; m(\theta), \Sigma + V(\theta)\big),

m and V the mean and the variance of a Gaussian process on simulations of f. A simulator
that is itself the noise gives statistics s (:mod:`.summaries`) with a noise that is
learned with them, at this action and near the belief, and the density is that of
Student's t, as a variance from n simulations is uncertain.

References:
    Wood, Nature 2010 (synthetic likelihood); Rasmussen & Williams, 2006.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import logsumexp
from scipy.stats import chi2
from torch import Tensor

from sbi_active.arrays import Array
from sbi_active.inference.emulation.summaries import Statistic, learned_statistic
from sbi_active.inference.regression.outcomes import TrialOutcome
from sbi_active.inference.regression.regions import Region
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.sampling.gaussian_process import (
    GaussianProcess,
    Kind,
    ProcessSettings,
)
from sbi_active.inference.sampling.mixtures import log_student
from sbi_active.seeding import derive_seed
from sbi_active.simulation.noise.base import NoiseModel
from sbi_active.simulation.noise.gaussian import GaussianNoise


@dataclass(frozen=True)
class TrialLikelihood:
    """Likelihood of one trial as a function of the prior's coordinates.

    Attributes:
        region: Region whose coordinates the processes take.
        processes: One for all numbers where noise is declared, else one each; empty
            where nothing was measured.
        observed: The numbers that were observed, or their statistics, shape (q,).
        noise: Declared noise; None if it was learned.
        x_shape: Shape of the outcome that noise is declared for.
        used: Which of its numbers were observed, shape (k,).
        root: Cholesky factor of the correlation of the noise, shape (q, q).
        freedom: Degrees of freedom of learned noise.
        outcome: Probability of a measurement, or of none; None where simulations agree.
    """

    region: Region
    processes: tuple[GaussianProcess, ...]
    observed: Array
    noise: NoiseModel | None
    x_shape: tuple[int, ...]
    used: NDArray[np.bool_]
    root: Array
    freedom: float = np.inf
    outcome: TrialOutcome | None = None

    def log_likelihood(self, z: Array) -> Array:
        """Return log densities, (n, d) -> (n,)."""
        total = np.zeros(len(z))
        if self.outcome is not None:
            total = total + self.outcome.log_prob(z)
        if not self.processes:
            return total
        noise = self.noise
        is_white = type(noise) is GaussianNoise and noise.posterior is None
        if noise is not None and not is_white:
            mean = self.predict(z)[0]
            seen = self._full(np.broadcast_to(self.observed, mean.shape), np.nan)
            declared = noise.log_prob(seen, self._full(mean, 0.0))
            return total + declared.double().numpy()
        white, spread = self._whitened(z)
        log_volume = np.log(spread).sum(1) + np.log(np.diag(self.root)).sum()
        square, size = (white**2).sum(1), white.shape[1]
        if noise is None:
            return total + log_student(square, log_volume, size, self.freedom)
        return total - 0.5 * (square + size * np.log(2 * np.pi)) - log_volume

    def predict(self, z: Array) -> tuple[Array, Array]:
        """Return mean and variance without noise, both (n, q)."""
        u = self.region.scaled(z)
        parts = [process.predict(u) for process in self.processes]
        means, variances = zip(*parts, strict=True)
        return np.concatenate(means, 1), np.concatenate(variances, 1)

    def draw(self, z: Array, rng: np.random.Generator) -> Array:
        """Return outcomes or statistics at parameters (n, d), noise and all, (n, q)."""
        mean, variance = self.predict(z)
        drawn = mean + np.sqrt(variance) * rng.standard_normal(mean.shape)
        if self.noise is None:
            normal = rng.standard_normal(mean.shape) @ self.root.T
            scale = np.sqrt(self.freedom / rng.chisquare(self.freedom, (len(z), 1)))
            return drawn + self.noise_sd * normal * scale
        seeds = torch.from_numpy(rng.integers(2**62, size=len(z)))
        noisy = self.noise.sample(self._full(drawn, 0.0), seeds)
        return noisy.reshape(len(z), -1).numpy()[:, self.used]

    def error(self, z: Array) -> float:
        """Return the nats that simulations are too few by, about, at draws (n, d)."""
        if not self.processes:
            return 0.0
        ratio = (self.predict(z)[1] / self.noise_sd**2).mean(0)
        return float(0.5 * (ratio + (self.noise is None) / self.freedom).sum())

    def tail(self, z: Array) -> float:
        """Return how often simulations at draws (n, d) lie as far out as the trial."""
        if not self.processes:
            return 1.0
        white = self._whitened(z)[0]
        return float(chi2.sf((white**2).sum(1), white.shape[1]).mean())

    def gain(
        self, z: Array, rng: np.random.Generator, *, num: int = 728, outer: int = 128
    ) -> float:
        """Return the information of an outcome at this action, nats.

        Args:
            z: Draws of the parameters, shape (n, d).
            rng: Source of the noise.
            num: Number of parameters.
            outer: Number of those that outcomes are drawn at.
        """
        if not self.processes:
            return 0.0
        mean, variance = self.predict(np.resize(z, (num, z.shape[1])))
        normal = rng.standard_normal((outer, mean.shape[1]))
        root = self.noise_sd[:, None] * self.root
        return float(mixture_gain(mean, variance, root, normal, outer).mean())

    @property
    def noise_sd(self) -> Array:
        """Deviation of the noise, learned or declared, of what was observed, (q,)."""
        if self.noise is None:
            return np.concatenate([process.noise_sd for process in self.processes])
        sd = np.asarray(getattr(self.noise, "sd", 1.0), dtype=np.float64)
        return np.broadcast_to(sd, self.x_shape).reshape(-1)[self.used]

    def _whitened(self, z: Array) -> tuple[Array, Array]:
        """Return residuals in units of noise and interpolation, and their size."""
        mean, variance = self.predict(z)
        spread = np.sqrt(self.noise_sd**2 + variance)
        residual = (self.observed - mean) / spread
        return np.linalg.solve(self.root, residual.T).T, spread

    def _full(self, numbers: Array, fill: float) -> Tensor:
        """Return outcomes (n, *x_shape) of what is used, (n, q)."""
        full = np.full((len(numbers), len(self.used)), fill)
        full[:, self.used] = numbers
        return torch.from_numpy(full).reshape(len(numbers), *self.x_shape)


def declared_process(
    inputs: Array, numbers: Array, kinds: Sequence[Kind] = ("smooth", "rough")
) -> GaussianProcess:
    """Return the process of noise-free numbers, of the kernel of most evidence."""
    fits = [
        GaussianProcess.fit(
            inputs, numbers, noise="none", settings=ProcessSettings(kind=kind)
        )
        for kind in kinds
    ]
    return max(fits, key=lambda process: process.log_evidence)


def learned_processes(
    inputs: Array, numbers: Array, z: Array, *, seed: int
) -> tuple[Statistic, tuple[GaussianProcess, ...], Array]:
    """Return a statistic of noisy numbers, a process of each, and residuals.

    Args:
        inputs: Inputs of the processes, shape (n, D).
        numbers: Finite numbers of each simulation, shape (n, q).
        z: Coordinates of the parameters that the statistic estimates, shape (n, d).
        seed: Seed of the statistic's folds.

    Returns:
        Residuals are those of left-out rows, shape (n, s).
    """
    statistic, own = learned_statistic(numbers, z, seed=derive_seed(seed, "folds"))
    processes = tuple(
        GaussianProcess.fit(inputs, column[:, None], noise="learned")
        for column in own.T
    )
    return statistic, processes, np.concatenate([p.left_out for p in processes], 1)


def correlation_root(residual: Array, shrinkage: float = 10.0) -> Array:
    """Return the Cholesky factor of the correlation of residuals (n, q), shrunk.

    Args:
        residual: Residuals.
        shrinkage: Number of rows that independence counts for.
    """
    n, q = residual.shape
    unit = residual / np.maximum(np.sqrt((residual**2).mean(0)), 1e-30)
    correlation = (unit.T @ unit + shrinkage * np.eye(q)) / (n + shrinkage)
    return np.linalg.cholesky(correlation)


@dataclass(frozen=True)
class PooledLikelihood:
    """Likelihood of all trials, each learned from simulations at its own action.

    Attributes:
        coordinates: Coordinates of the prior.
        trials: One a trial.
    """

    coordinates: PriorCoordinates
    trials: tuple[TrialLikelihood, ...]

    def log_likelihood(self, z: Array) -> Array:
        """Return the log likelihood, (n, d) -> (n,)."""
        return np.sum([trial.log_likelihood(z) for trial in self.trials], axis=0)


def mixture_gain(
    mean: Array, variance: Array, root: Array, normal: Array, num_outer: int
) -> Array:
    r"""Return contributions to the information of the first parameters, (num_outer,).

    .. math::
        I = \mathrm E\left[\log p(x_i | \theta_i) - \log \frac{1}{M + 1}
        \sum_{j = 0}^M p(x_i | \theta_j)\right], \qquad \theta_0 = \theta_i,

    which is at most log(M + 1) (Foster et al., AISTATS 2020).

    Args:
        mean: Mean outcomes at the parameters, shape (m, q).
        variance: Variance of the mean, shape (m, q).
        root: Cholesky factor of the noise, shape (q, q).
        normal: Standard normal numbers, shape (num_outer, q).
        num_outer: Parameters that outcomes are drawn at.
    """
    inverse = np.linalg.inv(root)
    m = mean @ inverse.T
    # Where simulations are few is no property of the outcome: one variance for all.
    v = 1 + (variance @ (inverse**2).T).mean(0) + 0 * m
    x = m[:num_outer] + np.sqrt(v[:num_outer]) * normal
    own = -0.5 * (normal**2 + np.log(v[:num_outer])).sum(1)
    log_volume = 0.5 * np.log(v).sum(1)
    # (x - m)^2 / v summed over numbers, as products of matrices
    square = (x**2) @ (1 / v).T - 2 * x @ (m / v).T + ((m**2) / v).sum(1)
    every = -0.5 * square - log_volume
    keep = np.concatenate([every[:, num_outer:], own[:, None]], 1)
    return own - (logsumexp(keep, 1) - np.log(keep.shape[1]))
