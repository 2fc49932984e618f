r"""The oscillator's posterior by importance sampling, and what a trial tells.

References:
    Rainforth, Cornish, Yang, Warrington & Wood, "On nesting Monte Carlo estimators",
    ICML 2018, for the bias of the nested estimate.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from sbi.utils import BoxUniform
from torch import Tensor

from sbi_active.seeding import forked_generators
from sbi_active.tasks.oscillator.model import NOISE_SD, PRIOR_HIGH, PRIOR_LOW, mean
from sbi_active.tasks.reference import SampledPosterior

__all__ = ["OscillatorReference"]

LOG_2PI = math.log(2 * math.pi)
OUTCOMES = 6
BLOCK = 2**13  # rows evaluated at once, to stay in the cache


class OscillatorReference(SampledPosterior):
    r"""The posterior :math:`p(\theta \mid \mathcal D)` and what the next trial tells.

    Args:
        action: Actions :math:`(A, \Omega)`, shape (t, 2). No trials give the prior.
        x: Readings in cm, shape (t, 6).
        seed: Seed of the draws.
        noise_sd: Standard deviation of the readings, cm.

    Raises:
        ValueError: If shapes differ or a value is not finite.

    Example:
        >>> posterior = OscillatorReference([[1.0, 5.0]], [[0.1, 0.8, 0.2, -0.6, 0, 0]])
        >>> posterior.sample(3, seed=0).shape
        torch.Size([3, 4])
    """

    def __init__(
        self, action: object, x: object, *, seed: int = 0, noise_sd: float = NOISE_SD
    ) -> None:
        self.action, self.x = _rows(action, "action", 2), _rows(x, "x", OUTCOMES)
        if len(self.action) != len(self.x):
            raise ValueError(
                f"expected one x per action; got {len(self.action)} actions and "
                f"{len(self.x)} x; pass as many rows"
            )
        self.noise_sd = noise_sd
        prior = BoxUniform(PRIOR_LOW, PRIOR_HIGH)
        super().__init__(
            prior,
            self._log_of_trials,
            seed=seed,
            num_effective=10_000,
            num_draws=4_000,
            most=100_000,
            fewest=600,
        )

    def _log_of_trials(self, theta: Tensor, floor: Any = None) -> np.ndarray:
        total = torch.zeros(len(theta), dtype=torch.float64)
        for xi, x in zip(self.action, self.x, strict=True):
            blocks = theta.double().split(BLOCK)
            rows = torch.cat([mean(block, xi[None]) for block in blocks])
            total += self._log_noise((x - rows).square().sum(-1))
        return total.numpy()

    def _log_noise(self, squares: Tensor) -> Tensor:
        """Return the log density of a residual from its sum of squares."""
        scale = 0.5 * LOG_2PI + math.log(self.noise_sd)
        return -0.5 * squares / self.noise_sd**2 - OUTCOMES * scale

    def sample(self, num: int, *, seed: int | None = None) -> Tensor:
        """Return draws, shape (num, 4), of the prior itself without trials."""
        if len(self.x):
            return super().sample(num, seed=seed)
        with forked_generators(seed, "reference"):
            return self.prior.sample(torch.Size([num])).double()

    def expected_information_gain(
        self,
        action: object,
        *,
        num_outer: int = 1_000,
        num_inner: int = 100_000,
        seed: int = 0,
    ) -> tuple[Tensor, Tensor]:
        r"""Expected information gain of one more trial, by nested Monte Carlo.

        .. math::
            \mathrm{EIG}(\xi) = -\frac1n \sum_{i=1}^n \log \hat p(x_i \mid \xi)
            - H[\varepsilon], \qquad
            \hat p(x_i \mid \xi) = \frac1m \sum_{j=1}^m p(x_i \mid \theta_j, \xi)

        with :math:`(\theta_i, x_i)` and :math:`\theta_j` from the belief, and
        :math:`|\varepsilon_i|^2` as a control variate of known mean. The same draws
        serve every action.

        By Jensen's inequality this is too high, by half the relative variance of
        :math:`\hat p`, averaged, to second order. That is estimated, and subtracted.

        Args:
            action: Actions :math:`(A, \Omega)`, shape (a, 2).
            num_outer: Number of outer draws n.
            num_inner: Number of inner draws m. A gain of g nats leaves
                about :math:`m e^{-g}` of them effective.
            seed: Seed of all draws.

        Returns:
            Gain in nats and its standard error, both (a,).
        """
        generator = torch.Generator().manual_seed(seed)
        outer, inner = (
            self.sample(num, seed=seed + k)
            for k, num in enumerate((num_outer, num_inner))
        )
        shape = (num_outer, OUTCOMES)
        noise = torch.randn(shape, generator=generator, dtype=torch.float64)
        excess = 0.5 * noise.square().sum(-1) - OUTCOMES / 2
        entropy = OUTCOMES * (0.5 * LOG_2PI + 0.5 + math.log(self.noise_sd))
        found = []
        for xi in _rows(action, "action", 2):
            x = mean(outer, xi[None]) + self.noise_sd * noise
            means = mean(inner, xi[None])
            log_marginal, variance = self._log_marginal(x, means)
            gain = -log_marginal - entropy
            covariance = torch.cov(torch.stack([gain, excess]))
            gain = gain - covariance[0, 1] / covariance[1, 1] * excess
            error = ((gain.var() + variance.mean()) / num_outer).sqrt()
            found.append(torch.stack([gain.mean() - 0.5 * variance.mean(), error]))
        gains, errors = torch.stack(found).T if found else torch.empty(2, 0)
        return gains, errors

    def _log_marginal(self, x: Tensor, means: Tensor) -> tuple[Tensor, Tensor]:
        """Log means of p(x_i | theta_j) over j, and their variances, both (n,)."""
        values, variances = [], []
        for rows in x.split(64):  # 50 MB at a time
            squares = torch.cdist(rows, means).square()
            weight = (squares - squares.amin(-1, keepdim=True)) / self.noise_sd**2
            weight = (-0.5 * weight).exp()
            total = weight.sum(-1)
            top = self._log_noise(squares.amin(-1))
            values.append(top + total.log() - math.log(len(means)))
            share = torch.linalg.vecdot(weight, weight) / total.square()
            variances.append(share - 1 / len(means))
        return torch.cat(values), torch.cat(variances)


def _rows(values: object, name: str, dim: int) -> Tensor:
    rows = torch.as_tensor(values).double()
    if rows.numel() == 0:
        rows = rows.reshape(0, dim)
    if rows.ndim != 2 or rows.shape[1] != dim:
        raise ValueError(
            f"expected {name} of shape (n, {dim}); got {tuple(rows.shape)}; give "
            "one row each"
        )
    if not bool(rows.isfinite().all()):
        raise ValueError(f"expected finite {name}; got nan or inf; drop these rows")
    return rows
