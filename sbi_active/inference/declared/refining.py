"""The posterior of trials under declared noise: draws, and a simulated density."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.arrays import Array
from sbi_active.inference.beliefs.weighted import WeightedBelief
from sbi_active.inference.declared.diagnosing import (
    Contradiction,
    diagnose_fit,
    find_contradiction,
)
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.engine import (
    Fit,
    Found,
    Settings,
    SimulatedPotential,
    infer,
    search,
)
from sbi_active.inference.engine.potential import (
    MeanTable,
    SimulatedLikelihood,
    declares_noise,
    unchanged,
)
from sbi_active.inference.rounds.rows import (
    NOTHING_EXPLAINS,
    UnexplainedOutcomeError,
    warn_missing,
)
from sbi_active.inference.sampling.coordinates import (
    NormalCoordinates,
    PriorCoordinates,
)
from sbi_active.inference.sampling.mixtures import fitted_normals
from sbi_active.inference.sampling.weights import systematic
from sbi_active.seeding import derive_seed, forked_generators


@dataclass(frozen=True)
class Problem:
    """The posterior that is asked for.

    Attributes:
        simulator: ``simulator(theta, action)``.
        prior: The original prior.
        action: Executed actions, shape (t, action_dim).
        x: Outcomes of the actions, shape (t, *x_shape).
        hints: Distributions that say where else to look first.
        settings: Settings of the belief.
        seed: Seed of everything random.
    """

    simulator: Callable[..., Any]
    prior: Distribution
    action: Tensor
    x: Tensor
    hints: Sequence[Distribution]
    settings: RefinementOptions
    seed: int


@dataclass(frozen=True)
class DeclaredRecord:
    """The record that saves simulations when a further trial is known.

    Attributes:
        coordinates: Coordinates of the prior.
        table: Noise-free outcomes so far.
        screened: Draws of the prior that the search looked at first, shape (n, d); None
            if it got nowhere.
    """

    coordinates: NormalCoordinates
    table: MeanTable
    screened: Array | None


class SimulatedBelief(WeightedBelief):
    r"""The posterior of all trials, with the likelihood simulated and not learned.

    .. math::
        L(\theta) = \prod_k p\big(x_k \mid f(\theta, \xi_k)\big)

    Parameters that no trial informs, and that are independent of the others under the
    prior, are drawn from the prior afresh. ``log_prob`` elsewhere costs a simulation a
    trial and row; ``smooth_log_prob`` has a mixture fitted to the draws in place of the
    likelihood, and misses what the response does within its width.

    Args:
        prior: The original prior.
        potential: Potential of all trials.
        fit: Weighted draws, and the evidence.
        defensive: Share of the prior.
        num_fitted: Number of draws behind the smooth density.

    Attributes:
        free: Parameters that keep their prior, shape (d,).
    """

    histories: DeclaredRecord

    def __init__(
        self,
        prior: Distribution,
        potential: SimulatedPotential,
        fit: Fit,
        *,
        defensive: float,
        num_fitted: int = 1_000,
    ) -> None:
        coordinates = potential.coordinates
        super().__init__(prior, coordinates.base, fit.log_evidence, defensive=defensive)
        self._z, self._weight = coordinates.to_z(fit.u), fit.weight
        self._likelihood, rng = potential.likelihood, np.random.default_rng(0)
        self._normal = NormalCoordinates(coordinates.base, rng, keeps_edges=False)
        self.free = fit.free
        u = self._normal.from_z(self._z[systematic(self._weight, num_fitted, 0.5)])
        self._fitted = fitted_normals(u, 4, rng)

    def _drawn(self, num: int, rng: np.random.Generator) -> Array:
        # Resampled: a further likelihood would cost a simulation a trial. None comes
        # again before its weight asks for it.
        rows = systematic(self._weight, num, rng.random())
        z = self._z[rng.permutation(rows)]
        if not self.free.any():
            return z
        return np.where(self.free, self._coordinates.sample_prior(num, rng), z)

    def _smooth_log_prob(self, theta: Tensor) -> Tensor:
        z = self._coordinates.to_z(theta)
        u = self._normal.from_z(z)
        log_volume = self._normal.log_slope(u) - self._coordinates.log_jacobian(z)
        density = np.logaddexp(
            np.log1p(-self._defensive) + self._fitted.log_prob(u) + log_volume,
            np.log(self._defensive) + self._log_prior(z),
        )
        return torch.from_numpy(density)

    def _log_likelihood(
        self, theta: Tensor, z: Array, *, beyond: float = 20.0
    ) -> Array:
        # So many nats below the defensive share a density is given up.
        floor = self.log_evidence + np.log(self._defensive) - beyond
        return self._likelihood(theta, floor=floor)


def refine_declared(problem: Problem, past: object) -> SimulatedBelief | None:
    """Return the posterior, if its likelihood can be simulated.

    Args:
        problem: Problem, whose simulator is deterministic beside a declared noise.
        past: Record of an earlier call, whose rows are not simulated again.

    Returns:
        None for another simulator.

    Raises:
        UnexplainedOutcomeError: If no parameters have a likelihood.
    """
    simulator, prior, settings = problem.simulator, problem.prior, problem.settings
    action, x, seed = problem.action, problem.x, problem.seed
    with forked_generators(derive_seed(seed, "few")):
        few = prior.sample(torch.Size([4])).float()
    if not declares_noise(simulator, few, action[:1].expand(len(few), -1)):
        return None
    rng = np.random.default_rng(derive_seed(seed, "declared"))
    if isinstance(past, DeclaredRecord) and past.table.simulator is simulator:
        coordinates, table, screened = past.coordinates, past.table, past.screened
        table.workers = settings.workers
    else:
        coordinates = NormalCoordinates(PriorCoordinates(prior, rng), rng)
        table, screened = MeanTable(simulator, settings.workers), None
    own = Settings(
        num_effective=settings.num_effective,
        num_simulations=3 * settings.num_histories * len(action),
        # Fewer reach a narrow posterior in fewer simulations.
        num_draws=max(settings.num_histories // 6, 100),
    )
    spent = table.num_simulations, table.num_missing
    declared = SimulatedLikelihood(table, action, x)
    potential = SimulatedPotential(declared, coordinates)
    near = _near(problem.hints, coordinates, seed)
    first = None if near is None else near[:2]
    found = search(potential, rng, first, own.search, screened=screened, believed=near)
    if found is not None:
        screened = found.screened[: own.search.num_screened]
    potential, found, contradiction = _inflated(potential, found, own, rng)
    fit = infer(potential, rng, found=found, near=near, settings=own)
    if not len(fit.u):
        raise UnexplainedOutcomeError(NOTHING_EXPLAINS)
    belief = SimulatedBelief(prior, potential, fit, defensive=settings.defensive)
    known = diagnose_fit(fit, potential, declared, seed)
    if contradiction is not None:
        known = contradiction.noted(known)
    num, missing = table.num_simulations - spent[0], table.num_missing - spent[1]
    belief.diagnostics = known.extended(num_simulations=num, num_missing=missing)
    belief.histories = DeclaredRecord(coordinates, table, screened)
    warn_missing(missing, num, "their draws")
    return belief


def _near(
    hints: Sequence[Distribution],
    coordinates: NormalCoordinates,
    seed: int,
    *,
    num: int = 250,
) -> Array | None:
    """Return draws of all hints, shape (n, d), those first that stand for each."""
    drawn = coordinates.base.drawn_from(hints[:2], num, seed=seed)
    drawn = [coordinates.from_z(z) for z in drawn]
    if not drawn:
        return None
    return np.concatenate([*[u[:1] for u in drawn], *[u[1:] for u in drawn]])


def _inflated(
    potential: SimulatedPotential,
    found: Found | None,
    own: Settings,
    rng: np.random.Generator,
    *,
    max_inflations: int = 3,
    num_around: int = 64,
    wide: float = 3.0,
    stable: float = 1.1,
) -> tuple[SimulatedPotential, Found | None, Contradiction | None]:
    """Return the modes of a noise that is inflated where trials contradict.

    Heavy tails have their best fit among ``num_around`` places, ``wide`` times the
    width of a mode around it; below ``stable`` the inflation is settled. It is found at
    most ``max_inflations`` times: once the noise is wider, a better fit may be found.
    """
    declared, c = potential.likelihood, potential.coordinates
    contradiction = None
    for _ in range(max_inflations):
        if found is None:
            break
        likelihood, best = potential.likelihood, found.modes[:1]
        residual, jacobian = potential.jacobian(best, unchanged, potential.step)
        around = best + wide * (found.guess.sample(num_around, rng) - best)
        around = np.clip(around, c.low, c.high)
        now = find_contradiction(
            declared,
            c.to_theta(np.concatenate([best, around])),
            residual[0] * likelihood.inflation,
            jacobian[0] * likelihood.inflation,
            rng=rng,
        )
        if now is None or now.inflation < stable * likelihood.inflation:
            break
        contradiction = now
        wider = SimulatedLikelihood(
            declared.table, declared.action, declared.x, inflation=now.inflation
        )
        potential = SimulatedPotential(wider, c)
        found = search(potential, rng, found.modes, own.search) or found
    return potential, found, contradiction
