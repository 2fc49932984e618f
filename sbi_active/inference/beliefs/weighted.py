"""Beliefs of weighted draws: a prior times a likelihood, and kernels around draws."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from sbi_active.arrays import Array
from sbi_active.inference.beliefs.belief import Belief, within_prior
from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.sampling.weights import scott
from sbi_active.seeding import forked_generators
from sbi_active.support import within_support


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
        return self._mixed(num_samples, self._defensive)

    @override
    def _typical(self, num_samples: int) -> Tensor:
        return self._mixed(num_samples, 0.0)

    def _mixed(self, num_samples: int, share: float) -> Tensor:
        """Return draws, some of which are the prior's, (num_samples, d)."""
        rng = np.random.default_rng(int(torch.randint(2**62, ())))
        num_prior = rng.binomial(num_samples, share)
        drawn = self._drawn(num_samples - num_prior, rng)
        prior = self._coordinates.sample_prior(num_prior, rng)
        z = rng.permutation(np.concatenate([drawn, prior]))
        return self._coordinates.to_theta(z)


class KernelBelief(Belief):
    r"""Gaussian kernels around weighted draws, cut off at the prior's support.

    .. math::
        b(\theta) = \frac{1[\theta \in \mathrm{supp}\, p]}{Z} \sum_i w_i\,
        \mathcal N(\theta; \theta_i, h^2 \hat\Sigma)

    with the draws' covariance and h by Scott's rule :math:`n^{-1 / (d + 4)}`, where n
    is the effective number of draws. The kernels widen the posterior by :math:`h^2` of
    its variance. Where few weights count, :math:`\hat\Sigma` says nothing; kernels of
    weighted draws are therefore wider by the distance between draws,
    :math:`n^{-2 / d}` of their unweighted covariance with n all of them.

    Args:
        prior: The original prior, which gives the support.
        draws: Draws, shape (n, theta_dim).
        weight: Normalized weights, shape (n,); None weighs all alike.

    References:
        Scott, *Multivariate Density Estimation*, 1992; Kim & Matsubara, Applied
        Intelligence 2025.
    """

    label = "kernel density estimate"

    def __init__(
        self,
        prior: Distribution,
        draws: Tensor,
        weight: Tensor | None = None,
        *,
        num_tried: int = 4_000,
        ridge: float = 1e-10,
    ) -> None:
        super().__init__(prior)
        draws = draws.double()
        n, d = draws.shape
        weighted = weight is not None
        weight = torch.full((n,), 1 / n) if weight is None else weight
        self._draws, self._weight = draws, weight.double() / weight.double().sum()
        effective = float(1 / self._weight.square().sum())
        width = scott(effective, d)
        center = self._weight @ draws
        step = draws - center
        covariance = (self._weight[:, None] * step).mT @ step
        largest = float(covariance.diagonal().max().clamp_min(1e-30))
        covariance = covariance + ridge * largest * torch.eye(d).double()
        covariance = width**2 * covariance
        if weighted:
            covariance = covariance + n ** (-2 / d) * torch.cov(draws.mT).reshape(d, d)
        self._factor = torch.linalg.cholesky(covariance)
        self._inverse = torch.linalg.inv(self._factor)
        self._kept = 1.0
        with forked_generators(0, "kernels"):
            inside = within_support(prior, self._draw(num_tried).float())
        self._kept = max(float(inside.double().mean()), 1 / num_tried)
        self.diagnostics = Diagnostics().extended(
            effective_sample_size=effective,
            bandwidth=width,
            mass_inside_prior=self._kept,
        )

    def _draw(self, num_samples: int) -> Tensor:
        index = torch.multinomial(self._weight, num_samples, replacement=True)
        noise = torch.randn(num_samples, self._draws.shape[1], dtype=torch.float64)
        return self._draws[index] + noise @ self._factor.mT

    def _sample(self, num_samples: int) -> Tensor:
        return within_prior(self.prior, self._draw, num_samples, self._kept)

    def _log_prob(self, theta: Tensor, *, block: int = 4_000_000) -> Tensor:
        places = self._draws @ self._inverse.mT
        size = max(block // len(places), 1)  # so many pairs are held in memory at once
        log_weight, parts = self._weight.log(), []
        for rows in (theta.double() @ self._inverse.mT).split(size):
            gap = torch.cdist(rows, places).square()
            parts.append((log_weight - 0.5 * gap).logsumexp(1))
        constant = 0.5 * theta.shape[1] * math.log(2 * math.pi) + math.log(self._kept)
        return torch.cat(parts) + self._inverse.diagonal().log().sum() - constant
