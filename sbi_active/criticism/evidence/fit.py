"""A rival with its posterior and its evidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.results import Evidence
from sbi_active.criticism.rivals.rival import Rival
from sbi_active.inference.engine import Fit as Sampled
from sbi_active.inference.engine import WeightedDraws

Array = NDArray[Any]


@dataclass(frozen=True)
class Fit:
    """A rival fitted to the trials.

    Attributes:
        rival: The model.
        sample: Sample of its posterior, weighted.
        evidence: Evidence that is recorded of it.
        best: Point from which other trials are predicted, shape (dim,); None takes the
            draws.
        mode: Point at which it is linear, shape (dim,); None if it was sampled.
    """

    rival: Rival
    sample: WeightedDraws
    evidence: Evidence
    best: Array | None = None
    mode: Array | None = None

    @property
    def likeliest(self) -> Array:
        """The mode or the draw of the largest density, shape (1, dim)."""
        if self.mode is not None:
            return self.mode[None]
        own = self.sample
        best = own.u[[int(np.argmax(own.weight))]]
        if not isinstance(own, Sampled) or own.found is None:
            return best
        u = np.concatenate([best, own.found.modes[:1]])
        log_p = self.rival.log_prior(u) + self.rival.log_likelihood(u)
        return u[[int(np.argmax(log_p))]]

    def weighted(self) -> tuple[Array, Array, Array]:
        """Return draws u (n, dim) with a weight, the weights, and residuals (n, N)."""
        some = self.sample.weight > 0
        u = self.sample.u[some]
        residual = self.rival.residual(u, penalized=False)[0]
        return u, self.sample.weight[some], residual
