"""The refined belief: a density of the original prior and a learned likelihood."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.beliefs.belief import Belief
from sbi_active.inference.engine.learned import LearnedFit
from sbi_active.inference.regression.histories import HistoryRecord

Array = NDArray[Any]

#: Least share of draws that sampling keeps.
MIN_ACCEPTANCE = 0.03
#: Draws of the proposal whose largest weight bounds all others.
NUM_BOUND = 4_000
#: Times as many draws as that needs, from which they are resampled instead: the
#: normalizer then rests on weights that fresh draws do not have.
PATIENCE = 3


class LearnedBelief(Belief):
    r"""The posterior of all trials given the original prior.

    .. math::
        b(\theta) = (1 - \epsilon)\, \frac{p(\theta)\, \hat L(\theta)}{Z}
        + \epsilon\, p(\theta), \qquad \hat L(\theta) \approx
        \prod_k p(x_k | \theta, \xi_k).

    Args:
        prior: Original prior p.
        fit: Posterior of the learned likelihood :math:`\hat L`, which gives Z and the
            proposal of draws.
        defensive: Share :math:`\epsilon` of the prior.

    Attributes:
        histories: The simulations behind it, to go on from after a further trial.
    """

    label = "refined"
    histories: HistoryRecord

    def __init__(
        self,
        prior: Distribution,
        fit: LearnedFit,
        *,
        defensive: float,
    ) -> None:
        super().__init__(prior)
        self._defensive, self._potential = defensive, fit.potential
        self._proposal, self._log_normalizer = fit.proposal, fit.fit.log_evidence
        # Draws are kept with probability weight / bound; a bound on all weights that
        # keeps too few is lowered, at the cost of a thinner tail.
        u = self._proposal.sample(NUM_BOUND, np.random.default_rng(0))
        largest = float(self._log_weight(u).max())
        self._log_bound = min(largest, self._log_normalizer - np.log(MIN_ACCEPTANCE))

    @property
    def log_evidence(self) -> float:
        """Log of the integral of prior times learned likelihood, nats."""
        return self._log_normalizer

    def log_likelihood(self, z: Array) -> Array:
        """Return the learned log likelihood at the prior's coordinates (n, d), (n,)."""
        return self._potential.learned.log_likelihood(z)

    def _log_prob(self, theta: Tensor) -> Tensor:
        coordinates = self._potential.learned.coordinates
        z = coordinates.to_z(theta)
        log_prior = coordinates.log_prior(z) - coordinates.log_jacobian(z)
        density = np.full(len(z), -np.inf)
        inside = np.isfinite(log_prior)
        log_likelihood = self._potential.learned.log_likelihood(z[inside])
        density[inside] = log_prior[inside] + np.logaddexp(
            np.log1p(-self._defensive) + log_likelihood - self._log_normalizer,
            np.log(self._defensive),
        )
        return torch.from_numpy(density)

    def _sample(self, num_samples: int) -> Tensor:
        seed = int(torch.randint(2**62, ()))
        rng = np.random.default_rng(seed)
        own, coordinates = self._potential, self._potential.coordinates
        num_prior = rng.binomial(num_samples, self._defensive)
        kept = [own.sample_prior(num_prior, rng)]
        missing = num_samples - num_prior
        acceptance = np.exp(self._log_normalizer - self._log_bound)
        seen: list[tuple[Array, Array]] = []
        left = PATIENCE * (int(1.1 * missing / acceptance) + 20)
        while missing > 0 and left > 0:
            u = self._proposal.sample(int(1.1 * missing / acceptance) + 20, rng)
            left -= len(u)
            log_weight = self._log_weight(u)
            accepted = np.log(rng.random(len(u))) < log_weight - self._log_bound
            kept.append(u[accepted][:missing])
            missing -= len(kept[-1])
            seen.append((u, log_weight))
        if missing > 0:
            u, log_weight = (np.concatenate(parts) for parts in zip(*seen, strict=True))
            kept.append(u[_resampled(log_weight, missing, rng)])
        return coordinates.to_theta(rng.permutation(np.concatenate(kept)))

    def _log_weight(self, u: Array) -> Array:
        """Return log of prior times likelihood over proposal, shape (n,)."""
        log_joint, own = np.full(len(u), -np.inf), self._potential
        log_prior = own.log_prior(u)
        inside = np.isfinite(log_prior)
        log_joint[inside] = log_prior[inside] + own.log_likelihood(u[inside])
        return log_joint - self._proposal.log_prob(u)


def _resampled(log_weight: Array, num: int, rng: np.random.Generator) -> NDArray[Any]:
    """Return indices in proportion to the weights, shape (num,)."""
    top = log_weight.max()
    if not np.isfinite(top):
        return rng.integers(len(log_weight), size=num)
    weight = np.exp(log_weight - top)
    return rng.choice(len(weight), size=num, p=weight / weight.sum())
