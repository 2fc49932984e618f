"""The refined belief: a density of the original prior and a learned likelihood."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.beliefs.weighted import WeightedBelief
from sbi_active.inference.engine.learned import LearnedFit

Array = NDArray[Any]


class LearnedBelief(WeightedBelief):
    r"""The posterior of all trials, by a learned likelihood.

    A likelihood costs nothing, so that draws are fresh ones.

    Args:
        prior: Original prior.
        fit: Posterior of the learned likelihood.
        defensive: Share of the prior.
    """

    def __init__(
        self, prior: Distribution, fit: LearnedFit, *, defensive: float
    ) -> None:
        self._fit, self._learned = fit, fit.potential.learned
        coordinates = self._learned.coordinates
        super().__init__(prior, coordinates, fit.log_evidence, defensive=defensive)

    def _drawn(self, num: int, rng: np.random.Generator) -> Array:
        return self._fit.draws(num, rng)

    def log_likelihood(self, z: Array) -> Array:
        """Return the learned log likelihood at the prior's coordinates (n, d), (n,)."""
        return self._learned.log_likelihood(z)

    def _log_likelihood(self, theta: Tensor, z: Array) -> Array:
        return self._learned.log_likelihood(z)
