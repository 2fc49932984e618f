r"""Covariance of a regression's residuals, many of which may be numbers of one trial.

References:
    Schafer & Strimmer, Stat. Appl. Genet. Mol. Biol. 2005 (shrinkage); Hartlap et al.,
    A&A 2007 (inverse of a covariance).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import get_lapack_funcs

Array = NDArray[Any]


@dataclass(frozen=True)
class ResidualCovariance:
    r"""Covariance S = L L^T with shrunk correlations.

    Correlations shrink by :math:`\lambda = \sum \mathrm{Var}(r_{ij}) / \sum r_{ij}^2`,
    apart within a trial and across trials. Noise does not correlate across trials,
    which are independent given theta; misfit does.

    Attributes:
        deviation: Deviation of the residuals, shape (q,).
        blocks: Outcomes that correlate, and the inverse Cholesky factor of their
            correlation; all at once, or trial by trial where S has nothing between
            them, which takes a ninth of the time for three.
        shrinkage: Shrinkage of the correlations within a trial and across trials, 1
            where S has none.
        precision: Factor that makes the inverse of the sample covariance unbiased.
        log_volume: log det L.
    """

    deviation: Array
    blocks: tuple[tuple[NDArray[np.intp], Array], ...]
    shrinkage: tuple[float, float]
    precision: float
    log_volume: float

    @staticmethod
    def of(
        standardized: Array,
        deviation: Array,
        freedom: int,
        trial: NDArray[np.intp],
        *,
        independent: bool,
    ) -> ResidualCovariance:
        """Return the covariance of residuals over their deviations, shape (n, q).

        Args:
            standardized: The residuals.
            deviation: Shape (q,).
            freedom: Rows less coefficients.
            trial: Trial of each outcome, shape (q,).
            independent: Whether there is no misfit, and so nothing across trials.
        """
        q = len(deviation)
        groups = trial if independent else np.zeros_like(trial)
        rows = [np.flatnonzero(groups == k) for k in np.unique(groups)]
        correlations = [
            standardized[:, r].T @ standardized[:, r] / freedom for r in rows
        ]
        across = 1.0
        if not independent and q:
            within = trial[:, None] == trial
            across = _shrinkage(correlations[0][~within], freedom)
            apart = np.where(within, 1.0, 1 - across)
            own = correlations[0][within]
        else:
            apart = 1.0
            own = np.concatenate([np.zeros(0), *(c.ravel() for c in correlations)])
        shrunk = _shrinkage(own, freedom, num_ones=q)
        blocks, log_volume = [], float(np.log(deviation).sum())
        for members, correlation in zip(rows, correlations, strict=True):
            correlation *= (1 - shrunk) * apart
            np.fill_diagonal(correlation, 1.0)
            factor = np.linalg.cholesky(correlation)
            (invert,) = get_lapack_funcs(("trtri",), (factor,))
            log_volume += float(np.log(np.diag(factor)).sum())
            blocks.append((members, invert(factor, lower=1)[0]))
        size = q if across < 1 else int(np.bincount(trial, minlength=1).max())
        free = 1 + (size - 1) * (1 - shrunk) ** 2
        precision = max((freedom - free - 1) / freedom, 0.2) if q else 1.0
        return ResidualCovariance(
            deviation, tuple(blocks), (shrunk, across), precision, log_volume
        )

    def whiten(self, rows: Array) -> Array:
        r"""Return :math:`L^{-1}` times each row, shape (n, q)."""
        white = np.empty_like(rows)
        for members, inverse in self.blocks:
            scaled = rows[:, members] / self.deviation[members]
            white[:, members] = scaled @ inverse.T
        return white


def alike(standardized: Array, freedom: int) -> float:
    r"""Return how many outcomes vary as one, :math:`\sum_{ij} r_{ij}^2 / q`.

    Less what chance adds to it, of residuals over their deviations, shape (n, q).
    """
    n, q = standardized.shape
    # Both products have the same sum of squares.
    product = standardized @ standardized.T if n < q else standardized.T @ standardized
    square = (product**2).sum() / freedom**2 - q * (q - 1) / freedom
    return float(max(square / max(q, 1), 1.0))


def _shrinkage(correlation: Array, freedom: int, num_ones: int = 0) -> float:
    """Return the shrinkage of correlations, of which some are one by definition."""
    if len(correlation) <= num_ones:
        return 1.0
    square = correlation**2
    total = square.sum() - num_ones
    variance = ((1 - square) ** 2).sum() / freedom
    return float(min(1.0, variance / max(total, 1e-300)))
