"""Refinement: the posterior of all trials, simulated where it is."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.beliefs.belief import require_support
from sbi_active.inference.beliefs.comparison import compare_orders
from sbi_active.inference.refinement.learned_belief import LearnedBelief
from sbi_active.inference.refinement.outcome_checks import check_outcomes
from sbi_active.inference.refinement.regression_error import SMALL, widened
from sbi_active.inference.refinement.settings import RefinementOptions
from sbi_active.inference.refinement.simulated import ExactRecord, refine_exactly
from sbi_active.inference.refinement.simulated_belief import SimulatedBelief
from sbi_active.inference.refinement.simulated_likelihood import (
    MeanTable,
    SimulatedLikelihood,
    declares_noise,
)
from sbi_active.inference.refinement.trust import (
    SERIOUS_MISFIT,
    Course,
    Stage,
    diagnose,
)
from sbi_active.inference.regression.histories import Histories, HistoryRecord
from sbi_active.inference.regression.regions import (
    PriorProposal,
    Region,
    RegionsProposal,
    around,
    cover,
    whole_space,
)
from sbi_active.inference.regression.surrogate import Surrogate
from sbi_active.inference.rounds.rows import UnexplainedOutcomeError
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.inference.sampling.population import (
    StudentProposal,
    population_monte_carlo,
)
from sbi_active.inference.sampling.student_mixture import Proposal
from sbi_active.inference.sampling.unbounding import Unbounding
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation.outcomes import MissingRowsWarning
from sbi_active.threads import single_thread

__all__ = ["RefinementOptions", "refine"]

Array = NDArray[Any]

HALF = 0.5  # of the budget, after which misfit is taken to stay
MANY = 6  # parameters beyond which each covariance needs more particles
MIN_STAGE = 60  # histories below which another stage adds nothing; more by dimension


def refine(
    simulator: Callable[..., Any],
    prior: Distribution,
    action: Tensor,
    x: Tensor,
    *,
    start: Distribution | Sequence[Distribution] | None = None,
    past: HistoryRecord | None = None,
    settings: RefinementOptions | None = None,
    seed: int,
) -> LearnedBelief | SimulatedBelief:
    r"""Return the posterior of all trials given the original prior.

    Stage by stage, over the whole prior and then in ellipsoids around what is still
    plausible: simulate every executed action at each parameter set, regress the
    outcomes on the parameters (:mod:`.surrogate`), sample prior
    times surrogate likelihood without simulations
    (:func:`.population_monte_carlo`), and put new
    ellipsoids around the sample. It ends when the residuals are pure noise and a stage
    changes nothing, or when the budget is spent.

    Misfit that stays, as of a response that jumps, is no noise. Where the simulator is
    noise-free beside a declared noise, a simulation gives the likelihood itself, and
    the posterior is then sampled with that
    (:func:`.importance_sample`), from the learned
    posterior or from the draws of the earlier call.

    A trial without a measurement counts by the probability of having none, one that was
    partly observed by the numbers that were (:mod:`.outcomes`).

    Args:
        simulator: ``simulator(theta, action)``; not kept in the result.
        prior: The original prior, with a support.
        action: Executed actions, shape (t, action_dim).
        x: Their observed outcomes, shape (t, *x_shape); NaN where nothing was measured.
        start: Where else to look first, for example a chained belief and the belief
            before the last trial. It adds simulations and no weight, so it cannot bias.
        past: ``belief.histories`` of an earlier call whose trials are the first of
            these: what still lies in a region is simulated at the new actions only.
        settings: Budget and shares; None is ``RefinementOptions()``.
        seed: Of everything random here.

    Returns:
        The belief; ``belief.diagnostics`` says how far to trust it.

    Raises:
        ValueError: If shapes do not fit, there is no trial, the simulator is
            deterministic, it almost never gives a measurement that a trial gave, or an
            outcome is so far away that no parameters have a likelihood.

    References:
        Wood, Nature 2010; Price et al., J. Comp. Graph. Stat. 2018 (synthetic
        likelihood); Cappe et al., J. Comp. Graph. Stat. 2004 (population Monte Carlo).

    Example:
        >>> from sbi.utils import BoxUniform
        >>> prior = BoxUniform(-torch.ones(1), torch.ones(1))
        >>> def simulator(theta, action):
        ...     return theta * action + 0.1 * torch.randn_like(theta)
        >>> action, x = torch.tensor([[1.0], [2.0]]), torch.tensor([[0.3], [0.6]])
        >>> belief = refine(simulator, prior, action, x, seed=0)
        >>> bool((belief.mean - 0.3).abs() < 0.05)
        True
    """
    prior = require_support(prior)
    settings = RefinementOptions() if settings is None else settings
    action, outcome = _trials(action, x)
    hints = [] if start is None else start
    hints = [hints] if isinstance(hints, Distribution) else [*hints]
    with single_thread():
        belief = None
        if isinstance(past, ExactRecord) and past.leads_to(simulator, action, outcome):
            past.table.workers = settings.workers
            belief = refine_exactly(
                prior,
                SimulatedLikelihood(past.table, action, outcome),
                past.coordinates,
                first=[],
                histories=past,
                pool=past.pool,
                settings=settings,
                seed=seed,
            )
        if belief is None:
            belief = _refine(
                simulator, prior, action, outcome, hints, past, settings, seed
            )
        if settings.check_order and isinstance(belief, LearnedBelief):
            other_seed = derive_seed(seed, "reversed")
            other = _refine(
                simulator,
                prior,
                action.flip(0),
                outcome.flip(0),
                hints,
                None,
                settings,
                other_seed,
            )
            compare_orders(belief, other)
    return belief


def _refine(
    simulator: Callable[..., Any],
    prior: Distribution,
    action: Tensor,
    outcome: Tensor,
    hints: Sequence[Distribution],
    past: HistoryRecord | None,
    settings: RefinementOptions,
    seed: int,
) -> LearnedBelief | SimulatedBelief:
    rng = np.random.default_rng(derive_seed(seed, "refine"))
    coordinates = PriorCoordinates(prior, rng)
    observed, workers = outcome.numpy().reshape(len(outcome), -1), settings.workers
    histories = Histories(simulator, action, observed, coordinates, seed, past, workers)

    regions = [whole_space(coordinates.dim)]
    for hint in hints:
        with forked_generators(derive_seed(seed, "start")):
            draws = coordinates.to_z(hint.sample(torch.Size([1_000])).float())
        regions.append(around(draws[coordinates.inside(draws)]))
    base: Proposal = PriorProposal(coordinates)
    first: Proposal | None = None
    course = Course()
    num_forced = 1
    least = max(MIN_STAGE, 2 * (coordinates.dim + 21))
    while True:
        stage_size = _stage_size(settings, histories.num_drawn, least)
        _simulate_stage(histories, regions, stage_size, settings, rng)
        next_size = _stage_size(settings, histories.num_drawn, least)
        is_last = next_size < least
        fits = [histories.regress(region) for region in regions]
        regressions = [fit for fit in fits if fit is not None]
        if not regressions:
            # It is not the outcomes that lack.
            if 2 * histories.valid.sum() > len(histories.valid):
                raise ValueError(
                    f"expected at least {least} histories for {coordinates.dim} "
                    f"parameters; got {histories.num_drawn}; raise num_histories"
                )
            raise UnexplainedOutcomeError(
                "expected simulations with a measurement, since trials had one; got "
                f"none or NaN in {histories.num_drawn - int(histories.valid.sum())} of "
                f"{histories.num_drawn} histories; do check the simulator at the "
                "executed actions, or the prior"
            )
        surrogate = Surrogate(coordinates, regressions, not is_last)
        stage = _sampled(surrogate, base, first, settings, rng)
        if stage.error > SMALL and len(course.stages) > 0:
            stage = _with_more(stage, histories, base, settings, rng)
        regressions, particles = stage.surrogate.regressions, stage.particles
        course.append(stage)
        if is_last or course.is_settled:
            break
        is_rough = stage.excess > SERIOUS_MISFIT
        if is_rough and histories.num_drawn >= HALF * settings.num_histories:
            few = coordinates.to_theta(stage.draws[:8])
            if declares_noise(simulator, few, action[:1].expand(8, -1)):
                break
        num_forced = (
            min(2 * max(num_forced, len(regions)), 32)
            if (course.is_stuck)
            else max(1, num_forced // 2)
        )
        limit = max(1, int(next_size / (1.2 * (coordinates.dim + 21))))
        regions = cover(
            particles,
            rng,
            min_regions=min(num_forced, limit),
            max_regions=min(max(settings.max_regions, num_forced), limit),
            generous=stage.excess < 3,
        )
        base = RegionsProposal(regions)
        points, line = particles.resample(800, rng), _unbounding(coordinates)
        first = StudentProposal.fit(points, 6, base, rng, line)

    if stage.excess > SERIOUS_MISFIT:
        few = coordinates.to_theta(stage.draws[:8])
        if declares_noise(simulator, few, action[:1].expand(8, -1)):
            table = MeanTable(simulator, workers)
            count = settings.num_histories // 4
            exact = refine_exactly(
                prior,
                SimulatedLikelihood(table, action, outcome),
                coordinates,
                first=[
                    (count, PriorProposal(coordinates)),
                    (count, particles.proposal),
                ],
                histories=histories.record(),
                pool=None,
                settings=settings,
                seed=seed,
            )
            if exact is not None:
                spent = exact.diagnostics.num_simulations + histories.num_simulations
                exact.diagnostics = exact.diagnostics.extended(num_simulations=spent)
                return exact

    diagnostics = diagnose(
        course,
        num_simulations=histories.num_simulations,
        share_invalid=histories.share_invalid,
        num_trials=len(action),
        rng=rng,
    )
    diagnostics = check_outcomes(diagnostics, surrogate, stage.draws, histories)
    # The residuals have served the diagnostics and would only weigh on the pickle.
    empty = np.zeros((0, observed.size))
    slim = [replace(r, residual=empty, standardized=empty) for r in regressions]
    surrogate = Surrogate(coordinates, slim)
    belief = LearnedBelief(prior, surrogate, particles, defensive=settings.defensive)
    belief.diagnostics = diagnostics
    belief.histories = histories.record()
    if histories.num_missing:
        warnings.warn(
            f"{histories.num_missing} of {histories.num_simulations} simulations of "
            "the refinement are missing, by faults of the simulator; the histories "
            "they belong to were left out",
            MissingRowsWarning,
            stacklevel=3,
        )
    return belief


def _stage_size(settings: RefinementOptions, used: int, least: int) -> int:
    share = settings.first_share if used == 0 else settings.stage_share
    size = max(int(share * settings.num_histories), least)
    left = settings.num_histories - used
    # A remainder too small for a stage of its own goes to the one before.
    return left if left < size + least else size


def _sampled(
    surrogate: Surrogate,
    base: Proposal,
    first: Proposal | None,
    settings: RefinementOptions,
    rng: np.random.Generator,
) -> Stage:
    """Return the stage of a surrogate, its density sampled.

    Raises:
        UnexplainedOutcomeError: If no parameters have a likelihood.
    """
    many = max(1.0, surrogate.coordinates.dim / MANY)
    num_components = 6 if len(surrogate.regressions) <= 4 else 10
    particles, _ = population_monte_carlo(
        surrogate.log_joint,
        base,
        rng,
        num_particles=int(many * settings.num_particles),
        first=first,
        num_components=num_components if many == 1 else num_components // 2,
        unbounding=_unbounding(surrogate.coordinates),
    )
    if not np.isfinite(particles.log_normalizer):
        raise UnexplainedOutcomeError(
            "expected outcomes that some parameters may explain; got none with a "
            "likelihood; correct the outcome, or leave the trial out"
        )
    return Stage.of(surrogate, particles, settings.defensive, rng)


def _unbounding(coordinates: PriorCoordinates) -> Unbounding | None:
    """Return the map to where edges are no concern, which a few edges are not."""
    is_needed = coordinates.bounded.sum() > MANY
    return Unbounding(coordinates.bounded) if is_needed else None


def _with_more(
    stage: Stage,
    histories: Histories,
    base: Proposal,
    settings: RefinementOptions,
    rng: np.random.Generator,
) -> Stage:
    """Return the stage with simulations from further off, where they are of use."""
    surrogate, bias = widened(histories, stage.surrogate, stage.error, stage.draws, rng)
    if surrogate is stage.surrogate:
        return stage
    wide = _sampled(surrogate, base, stage.particles.proposal, settings, rng)
    return replace(wide, error=wide.error + bias)


def _simulate_stage(
    histories: Histories,
    regions: list[Region],
    size: int,
    settings: RefinementOptions,
    rng: np.random.Generator,
) -> None:
    """Bring a stage's regions to their numbers, past histories first."""
    is_first = histories.num_drawn == 0
    num_places = size - max(int(settings.replicate_share * size), 12)
    shares = np.full(len(regions), 1 / len(regions))
    if is_first and len(regions) > 2:  # the overview keeps half of the stage
        shares = np.array([0.5, *[0.5 / (len(regions) - 1)] * (len(regions) - 1)])
    bounds = num_places * np.concatenate([[0.0], shares.cumsum()])
    counts = np.diff(np.round(bounds, 6).astype(int))
    for k, (region, count) in enumerate(zip(regions, counts, strict=True)):
        # The first stage's first region is the whole space, seen from the prior.
        is_overview = is_first and k == 0
        before = len(histories) - len(histories.second)
        histories.reuse(region, int(count), is_overview=is_overview)
        missing = int(count) - (len(histories) - len(histories.second) - before)
        if missing <= 0:
            continue
        z = rng.permutation(region.sample_inside(missing, histories.coordinates, rng))
        if len(z) == 0:  # it lies beside the support, as of an outcome far away
            z = histories.coordinates.sample_prior(missing, rng)
        num_replicates = missing * (size - num_places) // num_places
        histories.add(z, min(num_replicates, len(z)), is_overview=is_overview)


def _trials(action: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    action, x = torch.as_tensor(action), torch.as_tensor(x)
    if action.ndim != 2 or x.ndim < 1 or len(action) != len(x) or len(action) == 0:
        raise ValueError(
            "expected action (t, action_dim) and x (t, *x_shape) with as many trials, "
            f"at least one; got {tuple(action.shape)} and {tuple(x.shape)}; do stack "
            "the trials along axis 0"
        )
    return action.float().cpu(), x.double().cpu().reshape(len(x), *x.shape[1:] or (1,))
