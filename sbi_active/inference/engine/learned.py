"""The posterior of a likelihood that was learned, and its belief: no simulations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.arrays import Array
from sbi_active.inference.beliefs.weighted import WeightedBelief
from sbi_active.inference.engine.infer import infer
from sbi_active.inference.engine.settings import CHEAP
from sbi_active.inference.rounds.rows import NOTHING_EXPLAINS, UnexplainedOutcomeError
from sbi_active.inference.sampling.coordinates import (
    NormalCoordinates,
    PriorCoordinates,
)
from sbi_active.inference.sampling.mixtures import Proposal
from sbi_active.inference.sampling.weights import normalized, systematic


class LearnedLikelihood(Protocol):
    """A likelihood of all trials as a function of the prior's coordinates."""

    @property
    def coordinates(self) -> PriorCoordinates:
        """Coordinates of the prior."""
        ...

    def log_likelihood(self, z: Array) -> Array:
        """Return the log likelihood, (n, d) -> (n,)."""
        ...


class LearnedPotential:
    """The prior times a learned likelihood.

    It has no residuals, so that it is not searched, and no edges: draws near a bound
    would nearly all miss it where parameters are many.

    Args:
        learned: Learned likelihood of all trials.

    Attributes:
        dim: Number of parameters.
        num_trials: Number of likelihoods, which is one.
    """

    def __init__(self, learned: LearnedLikelihood) -> None:
        self.learned, self.dim = learned, learned.coordinates.dim
        self.num_trials, self.num_simulations = 1, 0
        # The same coordinates at each call.
        rng = np.random.default_rng(0)
        self.coordinates = NormalCoordinates(
            learned.coordinates, rng, keeps_edges=False
        )

    def sample_prior(self, num: int, rng: np.random.Generator) -> Array:
        """Return draws of the prior, shape (n, d)."""
        return self.coordinates.sample(num, rng)

    def simulated(self, u: Array) -> Array:
        """Return the places within the prior's support, shape (k, d)."""
        return u[self.coordinates.base.inside(self.coordinates.to_z(u))]

    def log_prior(self, u: Array) -> Array:
        """Return the log density of u under the prior, shape (n,)."""
        return self.coordinates.log_prior(u)

    def log_likelihood(self, u: Array, *, floor: float | Array = -np.inf) -> Array:
        """Return learned log likelihoods, shape (n,)."""
        return self.learned.log_likelihood(self.coordinates.to_z(u))


@dataclass(frozen=True)
class LearnedFit:
    """The posterior of a learned likelihood, by the proposal that was last fitted.

    Its draws were in no fit: none is there as often as it weighs.

    Attributes:
        potential: Prior times learned likelihood.
        proposal: Proposal that draws are from.
        efficiency: Share of its draws that are effective.
        effective_sample_size: Number of effective draws behind the evidence.
        log_evidence: Log of the integral of prior times likelihood, nats.
    """

    potential: LearnedPotential
    proposal: Proposal
    efficiency: float
    effective_sample_size: float
    log_evidence: float

    def draws(
        self,
        num: int,
        rng: np.random.Generator,
        *,
        plenty: int = 4,
        enough: int = 20_000,
        block: int = 50_000,
    ) -> Array:
        """Return the prior's coordinates of equally weighted draws, (num, d).

        Args:
            num: Number of draws.
            rng: Source of the draws.
            plenty: Effective draws that each is chosen from. Half leaves the worst of
                30 samples of a curved ridge .04 nats off, this .02 and twice .03.
            enough: Effective draws beyond which no more than ``num`` are taken.
            block: Draws of the proposal that are weighed at once.
        """
        wanted = min(plenty * num, max(num, enough)) / max(self.efficiency, 1e-3)
        parts: list[Array] = []
        for count in np.diff(np.linspace(0, num, int(wanted // block) + 2).astype(int)):
            size = int(np.ceil(wanted * count / max(num, 1)))
            u = self.potential.simulated(self.proposal.sample(size, rng))
            log_weight = self.potential.log_prior(u) - self.proposal.log_prob(u)
            weight = normalized(log_weight + self.potential.log_likelihood(u))
            parts.append(u[systematic(weight, int(count), rng.random())])
        return self.potential.coordinates.to_z(np.concatenate(parts))


def learned_fit(
    learned: LearnedLikelihood,
    rng: np.random.Generator,
    *,
    near: Array | None = None,
    num_effective: float = 200.0,
    oversampling: float = 16.0,
) -> LearnedFit:
    """Return the posterior of a learned likelihood.

    Args:
        learned: Learned likelihood of all trials.
        rng: Source of the draws.
        near: Prior's coordinates of draws of a guess, shape (n, d).
        num_effective: Number of effective draws that would be asked of a simulated
            likelihood; a log density is off by about its inverse root, in nats.
        oversampling: Number of effective draws to end with for each of these, since
            they cost no simulations. Half raises the error of a log density from .018
            to .025 nats at 200.

    Raises:
        UnexplainedOutcomeError: If nothing has a likelihood.
    """
    potential = LearnedPotential(learned)
    own = replace(CHEAP, num_effective=oversampling * num_effective)
    places = None if near is None else potential.coordinates.from_z(near)
    fit = infer(potential, rng, near=places, settings=own)
    if fit.final is None or not np.isfinite(fit.log_evidence):
        raise UnexplainedOutcomeError(NOTHING_EXPLAINS)
    effective = fit.effective_sample_size
    return LearnedFit(
        potential,
        fit.final,
        efficiency=effective / max(fit.num_drawn, 1),
        effective_sample_size=effective,
        log_evidence=fit.log_evidence,
    )


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

    def _log_likelihood(self, theta: Tensor, z: Array) -> Array:
        return self._learned.log_likelihood(z)
