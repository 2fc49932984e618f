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

    Args:
        prior: Original prior p.
        coordinates: Coordinates of the prior.
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
        log_evidence: float,
        *,
        defensive: float,
    ) -> None:
        super().__init__(prior)
        self._coordinates = coordinates
        self.log_evidence, self._defensive = log_evidence, defensive

    @abstractmethod
    def _drawn(self, num: int, rng: np.random.Generator) -> Array:
        """Return coordinates of draws but for the share of the prior, (num, d)."""

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
        drawn = self._drawn(num_samples - num_prior, rng)
        prior = self._coordinates.sample_prior(num_prior, rng)
        z = rng.permutation(np.concatenate([drawn, prior]))
        return self._coordinates.to_theta(z)
