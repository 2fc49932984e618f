"""The refined belief: a density of the original prior and a learned likelihood."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.beliefs.belief import Belief
from sbi_active.inference.regression.histories import HistoryRecord
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.sampling.population import Particles

Array = NDArray[Any]

#: Least share of draws that sampling keeps.
MIN_ACCEPTANCE = 0.03
#: Times as many draws as that needs, from which they are resampled instead: the
#: normalizer then rests on weights that fresh draws do not have.
PATIENCE = 3


class LearnedLikelihood(Protocol):
    """A likelihood of all trials as a function of the prior's coordinates."""

    @property
    def coordinates(self) -> PriorCoordinates:
        """Of the prior."""
        ...

    def log_likelihood(self, z: Array) -> Array:
        """Return the log likelihood, (n, d) -> (n,)."""
        ...

    def log_joint(self, z: Array) -> Array:
        """Return the log of prior times likelihood, -inf outside the support."""
        ...


class LearnedBelief(Belief):
    r"""The posterior of all trials given the original prior.

    .. math::
        b(\theta) = (1 - \epsilon)\, \frac{p(\theta)\, \hat L(\theta)}{Z}
        + \epsilon\, p(\theta), \qquad \hat L(\theta) \approx
        \prod_k p(x_k | \theta, \xi_k).

    Args:
        prior: The original prior p.
        surrogate: The prior times the learned likelihood :math:`\hat L`.
        particles: Importance sample of it, which gives Z and the proposal of draws.
        defensive: The share :math:`\epsilon`.

    Attributes:
        histories: The simulations behind it, to go on from after a further trial.
    """

    label = "refined"
    histories: HistoryRecord

    def __init__(
        self,
        prior: Distribution,
        surrogate: LearnedLikelihood,
        particles: Particles,
        *,
        defensive: float,
    ) -> None:
        super().__init__(prior)
        self._surrogate = surrogate
        self._defensive = defensive
        self._proposal = particles.proposal
        self._log_normalizer = particles.log_normalizer
        # Draws are kept with probability weight / bound; a bound on all weights that
        # keeps too few is lowered, at the cost of a thinner tail.
        largest = float(particles.log_weight.max())
        self._log_bound = min(largest, self._log_normalizer - np.log(MIN_ACCEPTANCE))

    def log_likelihood(self, z: Array) -> Array:
        """Return the learned log likelihood at the prior's coordinates (n, d), (n,)."""
        return self._surrogate.log_likelihood(z)

    def _log_prob(self, theta: Tensor) -> Tensor:
        coordinates = self._surrogate.coordinates
        z = coordinates.to_z(theta)
        log_prior = coordinates.log_prior(z) - coordinates.log_jacobian(z)
        density = np.full(len(z), -np.inf)
        inside = np.isfinite(log_prior)
        log_likelihood = self._surrogate.log_likelihood(z[inside])
        density[inside] = log_prior[inside] + np.logaddexp(
            np.log1p(-self._defensive) + log_likelihood - self._log_normalizer,
            np.log(self._defensive),
        )
        return torch.from_numpy(density)

    def _sample(self, num_samples: int) -> Tensor:
        seed = int(torch.randint(2**62, ()))
        rng = np.random.default_rng(seed)
        coordinates = self._surrogate.coordinates
        num_prior = rng.binomial(num_samples, self._defensive)
        kept = [coordinates.sample_prior(num_prior, rng)]
        missing = num_samples - num_prior
        acceptance = np.exp(self._log_normalizer - self._log_bound)
        seen: list[tuple[Array, Array]] = []
        left = PATIENCE * (int(1.1 * missing / acceptance) + 20)
        while missing > 0 and left > 0:
            z = self._proposal.sample(int(1.1 * missing / acceptance) + 20, rng)
            left -= len(z)
            log_weight = self._surrogate.log_joint(z) - self._proposal.log_prob(z)
            accepted = np.log(rng.random(len(z))) < log_weight - self._log_bound
            kept.append(z[accepted][:missing])
            missing -= len(kept[-1])
            seen.append((z, log_weight))
        if missing > 0:
            z, log_weight = (np.concatenate(parts) for parts in zip(*seen, strict=True))
            kept.append(z[_resampled(log_weight, missing, rng)])
        z = rng.permutation(np.concatenate(kept))
        return coordinates.to_theta(z)


def _resampled(log_weight: Array, num: int, rng: np.random.Generator) -> NDArray[Any]:
    """Return indices in proportion to the weights, shape (num,)."""
    top = log_weight.max()
    if not np.isfinite(top):
        return rng.integers(len(log_weight), size=num)
    weight = np.exp(log_weight - top)
    return rng.choice(len(weight), size=num, p=weight / weight.sum())
