"""Refinement with the simulated likelihood, where a learned one has misfit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.beliefs.diagnostics import Assumption, Diagnostics
from sbi_active.inference.declared.importance import WeightedPool, importance_sample
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.declared.simulated_belief import SimulatedBelief
from sbi_active.inference.declared.simulated_likelihood import (
    MeanTable,
    SimulatedLikelihood,
)
from sbi_active.inference.regression.histories import HistoryRecord
from sbi_active.inference.regression.regions import PriorProposal
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.sampling.student_mixture import Proposal
from sbi_active.messages import warn
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation.outcomes import MissingRowsWarning

Array = NDArray[Any]

USABLE = 5.0  # effective draws, below which the learned likelihood is kept
COARSE = 60.0  # effective draws, below which a warning is due
ROUGH = 3  # times the budget: what jumps needs more simulations than a regression
NUM_CHECKED = 200  # draws that tail probabilities rest on
EDGE = 0.5  # mass within 1 % of the edge of one parameter that calls for a warning
RARE = 1e-3  # tail probability of the observation that calls for a warning
NUM_REPEATS = 50  # of the noise a draw


@dataclass(frozen=True)
class ExactRecord(HistoryRecord):
    """Weighted draws to go on from when a further trial is known.

    Attributes:
        trials: Actions and outcomes in the likelihood of the draws.
        coordinates: In which they are.
        table: Noise-free outcomes so far.
        pool: The draws.
    """

    trials: tuple[Tensor, Tensor]
    coordinates: PriorCoordinates
    table: MeanTable
    pool: WeightedPool

    @staticmethod
    def of(
        histories: HistoryRecord,
        likelihood: SimulatedLikelihood,
        coordinates: PriorCoordinates,
        pool: WeightedPool,
    ) -> ExactRecord:
        """Add draws to the histories simulated before them."""
        own = {f.name: getattr(histories, f.name) for f in fields(HistoryRecord)}
        trials = likelihood.action, likelihood.x
        return ExactRecord(
            **own,
            trials=trials,
            coordinates=coordinates,
            table=likelihood.table,
            pool=pool,
        )

    def leads_to(self, simulator: Any, action: Tensor, x: Tensor) -> bool:
        """Whether its trials are the first of these, of the same simulator."""
        t = len(self.trials[0])
        return (
            self.table.simulator is simulator
            and torch.equal(self.trials[0], action[:t])
            and torch.equal(self.trials[1].nan_to_num(), x[:t].nan_to_num())
            and torch.equal(self.trials[1].isnan(), x[:t].isnan())
        )


def refine_exactly(
    prior: Distribution,
    likelihood: SimulatedLikelihood,
    coordinates: PriorCoordinates,
    *,
    first: Sequence[tuple[int, Proposal]],
    histories: HistoryRecord,
    pool: WeightedPool | None,
    settings: RefinementOptions,
    seed: int,
) -> SimulatedBelief | None:
    """Return the posterior by importance sampling; None where too few draws count.

    It begins at the pool of the first of these trials, or at the ``first`` numbers of
    draws and proposals. Histories simulated before are kept for the record.
    """
    table = likelihood.table
    before = table.num_simulations, table.num_missing
    pool = importance_sample(
        likelihood,
        coordinates,
        np.random.default_rng(derive_seed(seed, "exact")),
        first=first,
        base=PriorProposal(coordinates),
        past=pool,
        num_simulations=ROUGH * settings.num_histories * len(likelihood),
        num_draws=settings.num_draws or max(settings.num_histories // 6, 100),
        num_effective=settings.num_effective,
    )
    if pool.effective_sample_size < USABLE:
        return None
    belief = SimulatedBelief(
        prior, coordinates, likelihood, pool, defensive=settings.defensive
    )
    num_simulations = table.num_simulations - before[0]
    num_missing = table.num_missing - before[1]
    belief.diagnostics = diagnose_exactly(likelihood, coordinates, pool, seed).extended(
        num_simulations=num_simulations, num_missing=num_missing
    )
    belief.histories = ExactRecord.of(histories, likelihood, coordinates, pool)
    if num_missing:
        warn(
            f"{num_missing} of {num_simulations} simulations of the refinement are "
            "missing, by faults of the simulator; their draws were left out",
            MissingRowsWarning,
            stacklevel=5,
        )
    return belief


def diagnose_exactly(
    likelihood: SimulatedLikelihood,
    coordinates: PriorCoordinates,
    pool: WeightedPool,
    seed: int,
) -> Diagnostics:
    """Return figures about the draws, as of a learned likelihood where they apply."""
    effective = pool.effective_sample_size
    near_edge = np.abs(pool.z[:, coordinates.bounded]) > 0.98
    edge_mass = float((pool.weight @ near_edge).max(initial=0.0))
    tail = _tail_probability(likelihood, coordinates, pool, seed)
    warnings = []
    if effective < COARSE:
        warnings.append(
            f"the belief rests on {effective:.0f} effective draws, so that its log "
            f"density is off by about {effective**-0.5:.2g} nats; raise "
            "num_histories"
        )
    warnings += misplaced(tail[:-1], tail[-1], edge_mass)
    return Diagnostics(
        trustworthy=not warnings,
        warnings=(*warnings,),
        assumptions={"enough_draws": Assumption(effective >= COARSE, effective)},
        effective_sample_size=effective,
        tail_probability=tail[-1],
        tail_probability_of_trial=(*tail[:-1],),
        figures={
            "likelihood": "simulated",
            "num_stages": len(pool.proposals),
            "log_evidence": pool.log_evidence,
            "prior_edge_mass": edge_mass,
        },
    )


def misplaced(tail: list[float], joint: float, edge_mass: float) -> list[str]:
    """Return warnings of a belief that may be far from the truth.

    By the tail probability of each trial and of all, and the belief's mass near the
    edge of one parameter.
    """
    warnings = []
    if joint < RARE or min(tail) < RARE / len(tail):
        warnings.append(
            f"the observations are unlike anything simulated (tail probability "
            f"{min(joint, *tail):.1g}): the simulator lacks something, the prior "
            "excludes the truth, or a measurement is wrong"
        )
    if edge_mass > EDGE:
        warnings.append(
            f"{edge_mass:.0%} of the belief lies within 1 % of the prior's edge: the "
            "prior may exclude the truth"
        )
    return warnings


def _tail_probability(
    likelihood: SimulatedLikelihood,
    coordinates: PriorCoordinates,
    pool: WeightedPool,
    seed: int,
) -> list[float]:
    r"""Return how often the noise is less likely than what was observed.

    .. math::
        P\big(p(x' | \theta) \le p(x_o | \theta)\big), \quad \theta \sim b,\;
        x' \sim p(x | \theta),

    a trial and, last, for all trials.

    References:
        Gelman, Meng & Stern, Statistica Sinica 1996 (realized discrepancies).
    """
    rng = np.random.default_rng(derive_seed(seed, "tail"))
    rows = rng.choice(len(pool.z), size=NUM_CHECKED, p=pool.weight)
    theta = coordinates.to_theta(pool.z[rows])
    noise, size = likelihood.noise, NUM_CHECKED * NUM_REPEATS
    total_observed, total_simulated = np.zeros(size), np.zeros(size)
    tail = []
    for k, (action, x) in enumerate(zip(likelihood.action, likelihood.x, strict=True)):
        observed = np.repeat(likelihood.terms(theta, k), NUM_REPEATS)
        simulated = np.zeros(size)
        if bool(x.isfinite().any()):
            mean = torch.from_numpy(likelihood.table.mean(theta, action)[0])
            mean = mean.repeat_interleave(NUM_REPEATS, 0)
            with forked_generators(derive_seed(seed, "tail", k)):
                draws = noise.sample(mean).double()
            draws = torch.where(x.isfinite(), draws, torch.nan)
            simulated = noise.log_prob(draws, mean).double().numpy()
        tail.append(_share(simulated <= observed))
        total_observed += observed
        total_simulated += simulated
    return [*tail, _share(total_simulated <= total_observed)]


def _share(exceeds: NDArray[np.bool_]) -> float:
    return float((exceeds.sum() + 1) / (exceeds.size + 1))
