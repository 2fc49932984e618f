"""The fit of a posterior: weighted draws and figures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.inference.engine.pool import Pool
from sbi_active.inference.engine.search import Found
from sbi_active.inference.sampling.smc import Bridged

Array = NDArray[Any]


@dataclass(frozen=True, kw_only=True)
class WeightedDraws:
    """Weighted draws of a posterior, with its evidence.

    Attributes:
        u: Draws in the potential's coordinates, shape (n, d).
        weight: Weights of the draws, which sum to 1, shape (n,).
        log_evidence: Log of the integral of prior times likelihood, nats.
        standard_error: Standard error of log_evidence, nats.
        effective_sample_size: Number of draws that count.
        method: Method that gave the draws, "importance", "smc" or "laplace".
    """

    u: Array
    weight: Array
    log_evidence: float
    standard_error: float
    effective_sample_size: float
    method: str

    def draws(self, num: int, rng: np.random.Generator) -> Array:
        """Return equally weighted draws, shape (num, d)."""
        return self.u[rng.choice(len(self.u), num, p=self.weight)]


@dataclass(frozen=True, kw_only=True)
class Fit(WeightedDraws):
    """The posterior of a potential.

    Attributes:
        log_likelihood: Log likelihood of each draw, shape (n,).
        tail_shape: Shape of the tail of the weights; NaN where they are equal.
        is_rough: Whether the likelihood had to be tempered often.
        free: Parameters that keep their prior, shape (d,).
        found: Result of the search; None if it got nowhere.
        particles: Particles of sequential Monte Carlo; None of importance sampling.
        pool: Draws to go on from after a further trial.
    """

    log_likelihood: Array
    tail_shape: float = np.nan
    is_rough: bool = False
    free: NDArray[np.bool_]
    found: Found | None
    particles: Bridged | None = None
    pool: Pool
