"""Refinement of many parameters under declared noise: Gauss-Newton, then SMC."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.beliefs.diagnostics import Assumption
from sbi_active.inference.declared.contradiction import (
    MAX_INFLATIONS,
    find_contradiction,
)
from sbi_active.inference.declared.gauss_newton import (
    STEP,
    WIDER,
    Laplace,
    WhitenedTrials,
    find_laplace,
    unchanged,
)
from sbi_active.inference.declared.importance import WeightedPool
from sbi_active.inference.declared.mixture import mixture_sample
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.declared.simulated import (
    COARSE,
    ROUGH,
    ExactRecord,
    diagnose_exactly,
)
from sbi_active.inference.declared.simulated_belief import SimulatedBelief
from sbi_active.inference.declared.simulated_likelihood import (
    MeanTable,
    SimulatedLikelihood,
    declares_noise,
)
from sbi_active.inference.regression.histories import HistoryRecord
from sbi_active.inference.sampling.bridge import Bridged, NormalMixture, bridge
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.sampling.normal_coordinates import NormalCoordinates
from sbi_active.inference.sampling.population import GaussianMixture
from sbi_active.inference.sampling.weights import log_sum_exp, systematic
from sbi_active.seeding import derive_seed, forked_generators

Array = NDArray[Any]

PER_PARAMETER = 0.8  # times num_effective: particles a parameter
WIDTHS = ((1.0, 0.4), (2.0, 0.3), (3.0, 0.3))  # of the guess, and their weights
FEWEST = 400  # particles
FEW = 4  # parameters up to which three times the histories are enough
REMEMBERED = 0.3  # correlation of particles with where they began that is too much
NUM_INTEGRAL = 4_000  # draws, which cost no simulation
UNCHANGED = 2e-3  # deviations of the noise, which single precision may change
NUM_PROBES = 16  # draws at which uninformed parameters are changed
NUM_AROUND = 64  # parameters among which heavy tails have their best fit
STABLE = 1.1  # growth of the inflation below which it is settled
MOVING = 0.02  # share of moves accepted, below which particles are stuck


class BridgedBelief(SimulatedBelief):
    """The posterior of many parameters, its density simulated.

    Parameters that no trial informs, and that are independent of the others under the
    prior, are drawn from the prior afresh.

    Args:
        prior: The original prior.
        coordinates: In which it is nearly standard normal.
        likelihood: Of all trials.
        pool: Equally weighted draws.
        free: Parameters that keep their prior, shape (d,).
        defensive: Share of the prior.
    """

    def __init__(
        self,
        prior: Distribution,
        coordinates: NormalCoordinates,
        likelihood: SimulatedLikelihood,
        pool: WeightedPool,
        free: NDArray[np.bool_],
        *,
        defensive: float,
    ) -> None:
        base = coordinates.base
        super().__init__(prior, base, likelihood, pool, defensive=defensive)
        self.free, self._normal = free, coordinates
        rng = np.random.default_rng(0)
        u = coordinates.from_z(self._z)
        u = u[systematic(self._weight, len(u), 0.5)]
        fit = GaussianMixture.fit(u, 2 if len(u) > 8 * u.shape[1] else 1, rng)
        self._fitted = NormalMixture(np.exp(fit.log_weight), fit.mean, fit.factor)

    def _sample(self, num_samples: int) -> Tensor:
        theta = super()._sample(num_samples)
        if self.free.any():
            fresh = self.prior.sample(torch.Size([num_samples])).to(theta)
            theta = torch.where(torch.from_numpy(self.free), fresh, theta)
        return theta

    def _smooth_log_prob(self, theta: Tensor) -> Tensor:
        z = self._coordinates.to_z(theta)
        u = self._normal.from_z(z)
        log_volume = self._normal.log_slope(u) - self._coordinates.log_jacobian(z)
        log_prior = self._coordinates.log_prior(z) - self._coordinates.log_jacobian(z)
        density = np.logaddexp(
            np.log1p(-self._defensive) + self._fitted.log_prob(u) + log_volume,
            np.log(self._defensive) + log_prior,
        )
        return torch.from_numpy(density)


def refine_many(
    simulator: Callable[..., Any],
    prior: Distribution,
    action: Tensor,
    x: Tensor,
    *,
    hints: Sequence[Distribution],
    past: HistoryRecord | None,
    settings: RefinementOptions,
    seed: int,
    weighted: bool = False,
) -> BridgedBelief | None:
    """Return the posterior of many parameters, if its likelihood can be simulated.

    Args:
        simulator: Deterministic beside a declared noise.
        prior: The original prior.
        action: Executed actions, shape (t, action_dim).
        x: Their outcomes, shape (t, *x_shape).
        hints: Where else to look first.
        past: Of an earlier call: where to look, and what needs no simulation again.
        settings: Budget.
        seed: Of everything random.
        weighted: Whether to try an importance sample from a mixture first: of few
            parameters it takes fewer simulations, and reaches heavier tails.

    Returns:
        None for another simulator, or where the budget does not reach the posterior.
    """
    with forked_generators(derive_seed(seed, "few")):
        few = prior.sample(torch.Size([4])).float()
    if not declares_noise(simulator, few, action[:1].expand(len(few), -1)):
        return None
    table, before = MeanTable(simulator, settings.workers), None
    if isinstance(past, ExactRecord):
        before = past.coordinates.to_theta(past.pool.z)
        if past.table.simulator is simulator:
            table = past.table
            table.workers = settings.workers
    rng = np.random.default_rng(derive_seed(seed, "many"))
    base = PriorCoordinates(prior, rng)
    coordinates = NormalCoordinates(base, rng)
    likelihood = SimulatedLikelihood(table, action, x)
    spent = table.num_simulations, table.num_missing
    near = []
    if before is not None and len(before):
        near += [before.mean(0, keepdim=True), before[len(before) // 2][None]]
    with forked_generators(derive_seed(seed, "start")):
        near += [hint.sample(torch.Size([1])).float() for hint in hints[:2]]
    points = None
    if near:
        z = base.to_z(torch.cat(near))
        inside = base.inside(z)
        points = coordinates.from_z(z[inside]) if inside.any() else None
    declared = likelihood
    trials = WhitenedTrials(likelihood, coordinates)
    laplace = find_laplace(trials, rng, points)
    if laplace is None:
        return None
    contradiction = None
    for _ in range(MAX_INFLATIONS):
        best = laplace.modes[:1]
        residual, jacobian = trials.jacobian(best, unchanged, STEP)
        around = laplace.modes[0] + WIDTHS[-1][0] * (
            laplace.guess.sample(NUM_AROUND, rng) - laplace.modes[0]
        )
        found = find_contradiction(
            declared,
            coordinates.to_theta(np.concatenate([best, around])),
            residual[0] * likelihood.inflation,
            jacobian[0] * likelihood.inflation,
            level=settings.contradiction_level,
            rng=rng,
        )
        if found is None or found.inflation < STABLE * likelihood.inflation:
            break
        contradiction = found
        likelihood = SimulatedLikelihood(
            table, action, x, inflation=contradiction.inflation
        )
        trials = WhitenedTrials(likelihood, coordinates)
        laplace = find_laplace(trials, rng, laplace.modes) or laplace
    free = _free(laplace, trials, rng)
    pool, doubts, moved = None, [], {}
    if weighted and not free.any():
        pool = mixture_sample(likelihood, coordinates, laplace.guess, settings, rng)
    if pool is not None:
        effective = pool.effective_sample_size
        error = effective**-0.5
    else:
        found = _bridged(laplace, likelihood, coordinates, free, settings, rng)
        if found is None:
            return None
        z = coordinates.to_z(found.u)
        z = base.to_z(base.to_theta(z))  # the parameters that were simulated
        ok = base.inside(z)
        pool = _pool(z[ok], found.log_likelihood[ok], found.log_evidence, base, len(x))
        effective, error = found.effective_sample_size, found.standard_error
        moves = found.acceptance >= MOVING and found.memory <= REMEMBERED
        moved = {"particles_move": Assumption(moves, found.acceptance)}
        if not moves:
            doubts.append(
                f"{found.acceptance:.1%} of the moves of the particles were accepted, "
                "too few for them to reach the posterior; raise num_histories"
            )
    belief = BridgedBelief(
        prior, coordinates, likelihood, pool, free, defensive=settings.defensive
    )
    known = diagnose_exactly(declared, base, pool, seed)
    if contradiction is not None:
        known = contradiction.noted(known)
    twice = laplace.num_found >= 2
    if not twice:
        doubts.append(
            f"the best mode was found by one of {laplace.num_starts} searches, so that "
            "a better one may be missed; check against another seed"
        )
    enough = effective >= COARSE
    if not enough:
        doubts.append(
            f"the belief rests on {effective:.0f} independent particles; raise "
            "num_effective"
        )
    belief.diagnostics = known.warned(*doubts).extended(
        assumptions={
            "enough_draws": Assumption(enough, effective),
            **moved,
            "mode_found_twice": Assumption(twice, float(laplace.num_found)),
        },
        effective_sample_size=effective,
        error_nats=error,
        num_simulations=table.num_simulations - spent[0],
        num_missing=table.num_missing - spent[1],
        num_modes=len(laplace.modes),
        num_uninformed=int(free.sum()),
        log_evidence_error=error,
    )
    histories = _nothing(action, x, base.dim)
    belief.histories = ExactRecord.of(histories, likelihood, base, pool)
    return belief


def _free(
    laplace: Laplace, trials: WhitenedTrials, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Return parameters that change no trial and do not depend on others."""
    c, free = trials.coordinates, ~laplace.informed
    none = np.zeros(c.dim, dtype=bool)
    if not free.any() or free.all():
        return none
    drawn, other = (c.sample(NUM_PROBES, rng) for _ in range(2))
    near, off = (laplace.guess.sample(NUM_PROBES, rng) for _ in range(2))

    def changes(axes: NDArray[np.bool_]) -> bool:
        pairs = (drawn, np.where(axes, other, drawn)), (near, np.where(axes, off, near))
        return any(
            np.abs(trials.residual(a)[0] - trials.residual(b)[0]).max() > UNCHANGED
            for a, b in pairs
        )

    for axis in np.flatnonzero(free):
        free[axis] = not changes(np.arange(c.dim) == axis)
    is_free = free.any() and c.splits_off(free, rng) and not changes(free)
    return free if is_free else none


def _bridged(
    laplace: Laplace,
    likelihood: SimulatedLikelihood,
    coordinates: NormalCoordinates,
    free: NDArray[np.bool_],
    settings: RefinementOptions,
    rng: np.random.Generator,
) -> Bridged | None:
    """Return particles of all parameters; only those that trials inform are moved."""
    guess, axes = laplace.guess, np.flatnonzero(~free)
    cov = guess.factors @ np.swapaxes(guess.factors, 1, 2)
    factors = np.linalg.cholesky(cov[:, axes[:, None], axes])
    # Tails that bend away from the normal of a mode are out of its own reach.
    own = NormalMixture(
        np.concatenate([guess.weights * weight for _, weight in WIDTHS]),
        np.concatenate([guess.means[:, axes]] * len(WIDTHS)),
        np.concatenate([factors * width for width, _ in WIDTHS]),
    )
    rest = np.zeros((1, coordinates.dim))

    def whole(u: Array) -> Array:
        full = np.repeat(rest, len(u), 0)
        full[:, axes] = u
        return full

    fixed = _log_free(coordinates, free, rng) if free.any() else 0.0
    num = int(PER_PARAMETER * len(axes) * settings.num_effective)
    found = bridge(
        lambda u: coordinates.log_prior(whole(u)) - fixed,
        lambda u: likelihood(coordinates.to_theta(whole(u))),
        own,
        rng,
        num_particles=max(num, FEWEST),
        most=ROUGH * settings.num_histories * max(1.0, len(axes) / FEW),
    )
    if found is None:
        return None
    u = coordinates.sample(len(found.u), rng)
    u[:, axes] = found.u
    values = {**vars(found), "u": u}
    return Bridged(**values)


def _log_free(
    c: NormalCoordinates, free: NDArray[np.bool_], rng: np.random.Generator
) -> float:
    r"""Return the prior's log density of the free coordinates at zero.

    Independent of the others, which stay at zero, it is

    .. math::
        p_F(0) = p(0) \Big/ \int p(0, u_F)\, du_F .
    """
    u = np.zeros((NUM_INTEGRAL, c.dim))
    u[:, free] = WIDER * rng.standard_normal((len(u), int(free.sum())))
    square = ((u[:, free] / WIDER) ** 2 + np.log(2 * np.pi * WIDER**2)).sum(1)
    log_w = c.log_prior(u) + 0.5 * square
    integral = log_sum_exp(log_w) - np.log(len(u))
    return float(c.log_prior(np.zeros((1, c.dim)))[0] - integral)


def _pool(
    z: Array, log_likelihood: Array, log_evidence: float, c: PriorCoordinates, t: int
) -> WeightedPool:
    """Return equally weighted draws as a pool with this evidence."""
    log_prior = c.log_prior(z)
    log_own = log_prior + log_likelihood - log_evidence
    everything = np.ones(len(z), dtype=bool)
    return WeightedPool(
        z, log_prior, log_likelihood, log_own, log_own, everything, len(z), [], t
    )


def _nothing(action: Tensor, x: Tensor, dim: int) -> HistoryRecord:
    """Return a record without histories: nothing was regressed."""
    numbers = np.zeros((0, *x.flatten(1).shape))
    flags, rows = numbers.astype(bool), np.zeros(0, dtype=bool)
    return HistoryRecord(
        action, torch.zeros(0, dim), numbers, flags, numbers, flags, rows, rows
    )
