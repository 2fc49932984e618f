"""Beliefs of weighted draws: a prior times the likelihood of all trials."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.beliefs.belief import Belief
from sbi_active.inference.sampling.coordinates import PriorCoordinates

Array = NDArray[Any]


class WeightedBelief(Belief):
    r"""The posterior of all trials given the original prior.

    .. math::
        b(\theta) = (1 - \epsilon)\, \frac{p(\theta)\, L(\theta)}{Z}
        + \epsilon\, p(\theta)

    Draws are resampled from the weighted ones of a fit, whose density costs nothing.

    Args:
        prior: Original prior p.
        coordinates: Coordinates of the prior.
        z: Draws in these coordinates, shape (n, d).
        weight: Weights of the draws, which sum to 1, shape (n,).
        log_evidence: Log of Z, nats.
        defensive: Share :math:`\epsilon` of the prior.

    Attributes:
        histories: Simulations that a refinement goes on from after a further trial.
        log_evidence: Log of the integral of prior times likelihood, nats.
    """

    label = "refined"
    histories: Any

    def __init__(
        self,
        prior: Distribution,
        coordinates: PriorCoordinates,
        z: Array,
        weight: Array,
        log_evidence: float,
        *,
        defensive: float,
    ) -> None:
        super().__init__(prior)
        self._coordinates, self._z, self._weight = coordinates, z, weight
        self.log_evidence, self._defensive = log_evidence, defensive

    @abstractmethod
    def _log_likelihood(self, theta: Tensor, z: Array) -> Array:
        """Return log likelihoods (n,) of parameters and their coordinates, (n, d)."""

    def _log_prior(self, z: Array) -> Array:
        """Return the prior's log density of parameters at coordinates (n, d), (n,)."""
        return self._coordinates.log_prior(z) - self._coordinates.log_jacobian(z)

    def _log_prob(self, theta: Tensor) -> Tensor:
        z = self._coordinates.to_z(theta)
        log_prior = self._log_prior(z)
        rows = np.isfinite(log_prior)
        log_likelihood = self._log_likelihood(theta[torch.from_numpy(rows)], z[rows])
        density = np.full(len(z), -np.inf)
        density[rows] = log_prior[rows] + np.logaddexp(
            np.log1p(-self._defensive) + log_likelihood - self.log_evidence,
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
