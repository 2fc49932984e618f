r"""Is a learned belief right? By simulations that it was not fitted to.

Fresh simulations at draws of the belief b show by how much the regression misses their
mean, e = whitened outcome less prediction, which moves the mean of the belief by about

.. math::
    \Delta = E_b \bigl[(J^\top J + P)^{-1} J^\top e\bigr],

with the derivatives J of the whitened prediction and the prior's precision P.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sbi_active.inference.beliefs.diagnostics import Assumption, Diagnostics
from sbi_active.inference.refinement.learned_belief import LearnedBelief
from sbi_active.inference.refinement.regional import Regions
from sbi_active.seeding import forked_generators

Array = NDArray[Any]

FEWEST = 20  # histories of a check
STEP = 0.05  # of differences, in deviations of the belief
STANDARD_ERRORS = 3.0  # of a shift below which it may be chance
PRECISION = 3.0  # of a uniform prior in [-1, 1]


@dataclass(frozen=True)
class Confirmation:
    """How far a learned belief is from what fresh simulations give.

    Attributes:
        shift: Largest error of a mean, in standard deviations of the belief.
        num_simulations: Rows simulated.
        limit: Largest shift of a belief that is to be trusted.
    """

    shift: float
    num_simulations: int
    limit: float

    @property
    def holds(self) -> bool:
        """Whether the shift lies within its limit."""
        return self.shift <= self.limit

    def noted(self, diagnostics: Diagnostics) -> Diagnostics:
        """Return diagnostics with the figures, and a warning where they are large."""
        known = diagnostics.extended(
            num_simulations=diagnostics.num_simulations + self.num_simulations,
            assumptions={
                **diagnostics.assumptions,
                "confirmed": Assumption(self.holds, self.shift),
            },
            mean_shift=self.shift,
        )
        if self.holds:
            return known
        return known.warned(
            "SA101 fresh simulations do not confirm the belief: its mean is off by "
            f"{self.shift:.2g} standard deviations; raise num_histories"
        )


def by_replicates(
    regions: Regions, belief: LearnedBelief, rng: np.random.Generator
) -> Confirmation:
    """Compare with fresh simulations at draws of the belief.

    Args:
        regions: Simulations that led to the belief.
        belief: Learned belief.
        rng: Source of the draws.
    """
    own, coordinates = regions.own, regions.coordinates
    num = max(FEWEST, int(own.checked_share * regions.budget))
    with forked_generators(int(rng.integers(2**62))):
        theta = belief.sample(torch.Size([num])).float()
    histories = regions.histories
    before = histories.num_simulations
    x, lost = histories.fresh(theta)
    z = coordinates.to_z(theta)
    sds, d = z.std(0) + 1e-300, z.shape[1]
    last = regions.course.stages[-1].surrogate
    label, moves = last.assign(z), np.full(z.shape, np.nan)
    for k, fit in enumerate(last.regressions):
        rows = np.flatnonzero((label == k) & ~lost)
        if not len(rows):
            continue
        predicted = fit.whitened(z[rows])[0]
        error = fit.whitened_outcomes(x[rows]) - predicted
        axes = STEP * np.diag(sds)
        moved = [(fit.whitened(z[rows] + axis)[0] - predicted) for axis in axes]
        slope = np.stack(moved, 2) / (STEP * sds)
        system = np.einsum("nqj,nqk->njk", slope, slope) + PRECISION * np.eye(d)
        score = np.einsum("nqj,nq->nj", slope, error)
        moves[rows] = np.linalg.solve(system, score[..., None])[..., 0]
    moves = moves[np.isfinite(moves).all(1)] / sds
    shift, error = np.inf, np.inf
    if len(moves) > 1:
        worst = int(np.abs(moves.mean(0)).argmax())
        shift = float(np.abs(moves.mean(0))[worst])
        error = float(moves[:, worst].std() / np.sqrt(len(moves)))
    used = histories.num_simulations - before
    limit = max(own.largest_shift, STANDARD_ERRORS * error)
    return Confirmation(shift, used, limit)
