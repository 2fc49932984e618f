"""The posterior under declared noise, by weighted draws and a simulated density."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.beliefs.belief import Belief
from sbi_active.inference.declared.importance import WeightedPool
from sbi_active.inference.declared.simulated_likelihood import SimulatedLikelihood
from sbi_active.inference.regression.histories import HistoryRecord
from sbi_active.inference.regression.regions import PriorProposal
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.sampling.kernels import KernelProposal

BEYOND = 20.0  # nats below the defensive share at which a density is given up


class SimulatedBelief(Belief):
    r"""The posterior of all trials, with the likelihood simulated and not learned.

    .. math::
        b(\theta) = (1 - \epsilon)\, \frac{p(\theta)}{Z} \prod_k
        p\big(x_k \mid f(\theta, \xi_k)\big) + \epsilon\, p(\theta)

    Draws are the weighted ones of an importance sample, again and again, whose
    density costs nothing. ``log_prob`` elsewhere costs a simulation a trial and row;
    ``smooth_log_prob`` has kernels around the draws in place of the likelihood, and
    misses what the response does within their width.

    Args:
        prior: The original prior p.
        coordinates: Of the prior.
        likelihood: Of all trials.
        pool: Weighted draws, which give Z.
        defensive: The share :math:`\epsilon`.

    Attributes:
        histories: What a refinement goes on from after a further trial.
    """

    label = "refined"
    histories: HistoryRecord

    def __init__(
        self,
        prior: Distribution,
        coordinates: PriorCoordinates,
        likelihood: SimulatedLikelihood,
        pool: WeightedPool,
        *,
        defensive: float,
    ) -> None:
        super().__init__(prior)
        self._coordinates, self._likelihood = coordinates, likelihood
        self._defensive = defensive
        self._log_evidence = pool.log_evidence
        self._z = pool.z[pool.is_final]
        self._weight = pool.weight[pool.is_final]
        self._kernels = KernelProposal.around(
            self._z, self._weight, PriorProposal(coordinates), np.random.default_rng(0)
        )

    def _smooth_log_prob(self, theta: Tensor) -> Tensor:
        z = self._coordinates.to_z(theta)
        log_jacobian = self._coordinates.log_jacobian(z)
        return torch.from_numpy(self._kernels.log_prob(z) - log_jacobian)

    def _log_prob(self, theta: Tensor) -> Tensor:
        z = self._coordinates.to_z(theta)
        log_prior = self._coordinates.log_prior(z) - self._coordinates.log_jacobian(z)
        rows = np.isfinite(log_prior)
        floor = self._log_evidence + np.log(self._defensive) - BEYOND
        density = np.full(len(z), -np.inf)
        log_likelihood = self._likelihood(theta[torch.from_numpy(rows)], floor=floor)
        density[rows] = log_prior[rows] + np.logaddexp(
            np.log1p(-self._defensive) + log_likelihood - self._log_evidence,
            np.log(self._defensive),
        )
        return torch.from_numpy(density)

    def _sample(self, num_samples: int) -> Tensor:
        rng = np.random.default_rng(int(torch.randint(2**62, ())))
        num_prior = rng.binomial(num_samples, self._defensive)
        row = rng.choice(len(self._z), size=num_samples - num_prior, p=self._weight)
        prior = self._coordinates.sample_prior(num_prior, rng)
        z = rng.permutation(np.concatenate([self._z[row], prior]))
        return self._coordinates.to_theta(z)
