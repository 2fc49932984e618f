r"""Is a learned belief right? By simulations that it was not fitted to.

Where the likelihood itself can be simulated, at draws of the belief b,

.. math::
    \delta(\theta) = \log L(\theta) - \log \hat L(\theta), \qquad
    \mathrm{KL}(b \| p) = \log E_b\, e^{\delta} - E_b\, \delta, \qquad
    \Delta = E_b\, w \theta - E_b\, \theta, \quad w \propto e^\delta .

Where it cannot, fresh simulations show by how much the regression misses their mean,
e = whitened outcome less prediction, and that moves the mean of the belief by about

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
from sbi_active.inference.declared.simulated_likelihood import SimulatedLikelihood
from sbi_active.inference.refinement.learned_belief import LearnedBelief
from sbi_active.inference.refinement.stages import Stages
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
        divergence: KL divergence of the belief from the posterior, nats; None where the
            likelihood cannot be simulated.
        shift: Largest error of a mean, in standard deviations of the belief.
        num_simulations: Rows simulated.
        limits: Largest divergence and shift of a belief that is to be trusted.
    """

    divergence: float | None
    shift: float
    num_simulations: int
    limits: tuple[float, float]

    @property
    def holds(self) -> bool:
        """Whether both lie within their limits."""
        divergence, shift = self.limits
        return (self.divergence or 0.0) <= divergence and self.shift <= shift

    def noted(self, diagnostics: Diagnostics) -> Diagnostics:
        """Return diagnostics with the figures, and a warning where they are large."""
        worst = self.shift if self.divergence is None else self.divergence
        known = diagnostics.extended(
            num_simulations=diagnostics.num_simulations + self.num_simulations,
            assumptions={
                **diagnostics.assumptions,
                "confirmed": Assumption(self.holds, worst),
            },
            mean_shift=self.shift,
        )
        if self.holds:
            return known
        kl = "" if self.divergence is None else f"by about {self.divergence:.2g} nats, "
        return known.warned(
            f"fresh simulations do not confirm the belief: it is off {kl}its mean by "
            f"{self.shift:.2g} standard deviations; raise num_histories"
        )


def by_likelihoods(
    stages: Stages,
    belief: LearnedBelief,
    likelihood: SimulatedLikelihood,
    rng: np.random.Generator,
) -> Confirmation:
    """Compare with the simulated likelihood at draws of the belief.

    Args:
        stages: Refinement that led to the belief.
        belief: Learned belief.
        likelihood: Likelihood of all trials.
        rng: Source of the draws.
    """
    settings, coordinates = stages.settings, stages.coordinates
    num = max(FEWEST, int(settings.checked_share * settings.num_histories / 2))
    with forked_generators(int(rng.integers(2**62))):
        theta = belief.sample(torch.Size([num])).float()
    z = coordinates.to_z(theta)
    delta = likelihood(theta) - belief.log_likelihood(z)
    delta = np.where(np.isfinite(delta), delta, -np.inf)
    top = delta.max()
    if not np.isfinite(top):
        divergence, shift = np.inf, np.inf
    else:
        weight = np.exp(delta - top)
        counts = np.isfinite(delta)
        mean = delta[counts].mean() if counts.all() else -np.inf
        divergence = max(0.0, float(top + np.log(weight.mean()) - mean))
        weight = weight / weight.sum()
        shift = float(np.abs((weight @ z - z.mean(0)) / (z.std(0) + 1e-300)).max())
    limits = settings.largest_divergence, settings.largest_shift
    return Confirmation(divergence, shift, likelihood.table.num_simulations, limits)


def by_replicates(
    stages: Stages, belief: LearnedBelief, rng: np.random.Generator
) -> Confirmation:
    """Compare with fresh simulations at draws of the belief.

    Args:
        stages: Refinement that led to the belief.
        belief: Learned belief.
        rng: Source of the draws.
    """
    settings, coordinates = stages.settings, stages.coordinates
    num = max(FEWEST, int(settings.checked_share * settings.num_histories))
    with forked_generators(int(rng.integers(2**62))):
        theta = belief.sample(torch.Size([num])).float()
    histories = stages.histories
    before = histories.num_simulations
    x, lost = histories.fresh(theta)
    z = coordinates.to_z(theta)
    sds, d = z.std(0) + 1e-300, z.shape[1]
    last = stages.course.stages[-1].surrogate
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
    limit = max(settings.largest_shift, STANDARD_ERRORS * error)
    return Confirmation(None, shift, used, (settings.largest_divergence, limit))
