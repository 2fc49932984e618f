"""The smallest sum of squares in a box, with SciPy: local fits from many draws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

__all__ = ["Search"]

Array = NDArray[Any]


@dataclass(frozen=True, kw_only=True)
class Search:
    """How a box is searched.

    Attributes:
        draws: Uniform ones in the box.
        starts: Best ones of them, each of which a local fit starts from.
        evaluations: At most in a local fit, derivatives not counted.
        difference: Step of derivatives, of the box's width.
    """

    draws: int
    starts: int
    evaluations: int
    difference: float

    def best(
        self, residual: Callable[[Array], Array], dim: int, seed: int
    ) -> tuple[Array, float]:
        """Return where in the unit box the sum of squares is smallest, and half of it.

        Args:
            residual: Of rows in the unit box, shape (n, dim), giving (n, m).
            dim: Of the box.
            seed: Of the draws.
        """

        def value(z: Array) -> Array:
            return residual(z[None])[0]

        def jacobian(z: Array) -> Array:
            step = np.where(z + self.difference > 1, -self.difference, self.difference)
            every = residual(np.concatenate([z[None], z + np.diag(step)]))
            return ((every[1:] - every[0]) / step[:, None]).T

        z = np.random.default_rng(seed).uniform(size=(self.draws, dim))
        cost = (residual(z) ** 2).sum(1)
        found = [
            least_squares(
                value,
                start,
                jacobian,  # type: ignore[arg-type]  # SciPy's stub has the string alone
                bounds=(0, 1),
                max_nfev=self.evaluations,
            )
            for start in z[np.argsort(cost)[: self.starts]]
        ]
        best = min(found, key=lambda fit: fit.cost)
        return best.x, best.cost
