r"""The likelihood of a trial, learned from simulations at its action.

With declared noise the noise-free outcome f is interpolated,

.. math::
    p(x | \theta) = \mathcal N\big(x; m(\theta), \Sigma + V(\theta)\big),

m and V the mean and the variance of a Gaussian process on simulations of f. A simulator
that is itself the noise gives statistics s (:mod:`.statistics`) with a noise that is
learned with them, at this action and near the belief, and the density is that of
Student's t, as a variance from n simulations is uncertain.

References:
    Wood, Nature 2010 (synthetic likelihood); Rasmussen & Williams, 2006.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import logsumexp
from scipy.stats import chi2

from sbi_active.inference.emulation.summaries import Statistic, learned_statistic
from sbi_active.inference.regression.outcomes import TrialOutcome
from sbi_active.inference.regression.process import (
    GaussianProcess,
    Kind,
    ProcessSettings,
)
from sbi_active.inference.regression.regions import Region
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.sampling.student_mixture import log_student
from sbi_active.seeding import derive_seed
from sbi_active.simulation.noise.base import NoiseModel
from sbi_active.simulation.noise.gaussian import GaussianNoise

Array = NDArray[Any]


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
        root: Cholesky factor of the correlation of learned noise, shape (q, q).
        freedom: Degrees of freedom of learned noise.
        outcome: Probability of a measurement, or of none; None where simulations agree.
        label: Label of the summary.
        num_rows: Simulations behind it.
    """

    region: Region
    processes: tuple[GaussianProcess, ...]
    observed: Array
    noise: NoiseModel | None
    x_shape: tuple[int, ...]
    used: NDArray[np.bool_]
    root: Array
    freedom: float
    outcome: TrialOutcome | None
    label: str
    num_rows: int

    def log_likelihood(self, z: Array) -> Array:
        """Return log densities, (n, d) -> (n,)."""
        total = np.zeros(len(z))
        if self.outcome is not None:
            total = total + self.outcome.log_prob(z)
        if not self.processes:
            return total
        mean, variance = self.predict(z)
        residual = self.observed - mean
        if self.noise is None:
            return total + self._student(residual, variance)
        if type(self.noise) is GaussianNoise and self.noise.posterior is None:
            spread = self.declared_sd**2 + variance
            density = residual**2 / spread + np.log(2 * np.pi * spread)
            return total - 0.5 * density.sum(1)
        return total + self._declared(mean)

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
            return drawn + self.learned_sd * normal * scale
        full = np.zeros((len(z), len(self.used)))
        full[:, self.used] = drawn
        seeds = torch.from_numpy(rng.integers(2**62, size=len(z)))
        x = torch.from_numpy(full).reshape(len(z), *self.x_shape)
        noisy = self.noise.sample(x, seeds).reshape(len(z), -1).numpy()
        return noisy[:, self.used]

    def error(self, z: Array) -> float:
        """Return the nats that simulations are too few by, about, at draws (n, d)."""
        if not self.processes:
            return 0.0
        _, variance = self.predict(z)
        if self.noise is None:
            ratio = variance / self.learned_sd**2
            return float(0.5 * (ratio.mean(0) + 1 / self.freedom).sum())
        return float(0.5 * (variance / self.declared_sd**2).mean(0).sum())

    def tail(self, z: Array) -> float:
        """Return how often simulations at draws (n, d) lie as far out as the trial."""
        if not self.processes:
            return 1.0
        mean, variance = self.predict(z)
        is_learned = self.noise is None
        sd = np.sqrt(
            (self.learned_sd if is_learned else self.declared_sd) ** 2 + variance
        )
        white = (self.observed - mean) / sd
        if is_learned:
            white = np.linalg.solve(self.root, white.T).T
        return float(chi2.sf((white**2).sum(1), mean.shape[1]).mean())

    @property
    def learned_sd(self) -> Array:
        """Deviation of the learned noise, shape (q,)."""
        return np.concatenate([process.noise_sd for process in self.processes])

    @property
    def declared_sd(self) -> Array:
        """Deviation of the declared noise of the numbers observed, shape (q,)."""
        assert self.noise is not None
        sd = np.asarray(getattr(self.noise, "sd", 1.0), dtype=np.float64)
        return np.broadcast_to(sd, self.x_shape).reshape(-1)[self.used]

    def _student(self, residual: Array, variance: Array) -> Array:
        spread = np.sqrt(self.learned_sd**2 + variance)
        white = np.linalg.solve(self.root, (residual / spread).T).T
        log_volume = np.log(spread).sum(1) + np.log(np.diag(self.root)).sum()
        square = (white**2).sum(1)
        return log_student(square, log_volume, residual.shape[1], self.freedom)

    def _declared(self, mean: Array) -> Array:
        assert self.noise is not None
        full = np.full((len(mean), len(self.used)), np.nan)
        full[:, self.used] = mean
        seen = np.full(len(self.used), np.nan)
        seen[self.used] = self.observed
        shape = (len(mean), *self.x_shape)
        x = torch.from_numpy(np.broadcast_to(seen, full.shape).copy()).reshape(shape)
        at = torch.from_numpy(np.nan_to_num(full)).reshape(shape)
        return self.noise.log_prob(x, at).double().numpy()


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
        total = np.zeros(len(z))
        for trial in self.trials:
            total = total + trial.log_likelihood(z)
        return total


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
