"""Refinement: the posterior of all trials, simulated where it is, and confirmed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.expected import require
from sbi_active.inference.beliefs.enumerated import (
    EnumeratedBelief,
    Enumeration,
    enumerated,
)
from sbi_active.inference.beliefs.priors import require_support
from sbi_active.inference.declared.refining import (
    DeclaredRecord,
    Problem,
    SimulatedBelief,
    refine_declared,
)
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.emulation.emulation import Emulation
from sbi_active.inference.emulation.outcomes import fitted_summaries
from sbi_active.inference.emulation.pool import EmulatedTrial, Pool, noise_sds
from sbi_active.inference.emulation.regression import fewest_rows
from sbi_active.inference.emulation.stages import EmulationSettings
from sbi_active.inference.engine.learned import LearnedBelief
from sbi_active.inference.rounds.rows import warn_missing
from sbi_active.inference.sampling.coordinates import PriorCoordinates
from sbi_active.seeding import derive_seed
from sbi_active.simulation.outcomes import Simulations
from sbi_active.support import parameter_dim
from sbi_active.threads import single_thread


def refine(
    simulator: Callable[..., Any],
    prior: Distribution,
    action: Tensor,
    x: Tensor,
    *,
    start: Distribution | Sequence[Distribution] | None = None,
    past: Simulations | DeclaredRecord | None = None,
    settings: RefinementOptions | None = None,
    seed: int,
) -> LearnedBelief | SimulatedBelief | EnumeratedBelief:
    r"""Return the posterior of all trials given the original prior.

    Where the simulator is noise-free beside a declared noise, a simulation gives the
    likelihood itself, and the posterior is sampled with that (:func:`.infer`).

    For any other simulator it is learned in stages, over the whole prior and then
    where it is still plausible: simulate every executed action, regress the outcomes on
    the parameters (:mod:`.regression`), sample prior times learned likelihood without
    simulations (:func:`.learned_fit`), and simulate where the sample lies. It ends when
    the residuals are pure noise and a stage changes nothing, or when the budget is
    spent.

    A trial without a measurement counts by the probability of having none, one that was
    partly observed by the numbers that were (:mod:`.outcomes`).

    Args:
        simulator: ``simulator(theta, action)``; not kept in the result.
        prior: The original prior, with a support. Parameters of a few values, beside
            continuous ones in sbi's ``MultipleIndependent``, are enumerated.
        action: Executed actions, shape (t, action_dim).
        x: Their observed outcomes, shape (t, *x_shape); NaN where nothing was measured.
        start: Distributions to look at first, for example a chained belief and the
            belief before the last trial. It adds simulations and no weight, so it
            cannot bias.
        past: ``belief.histories`` of an earlier call for the same simulator.
        settings: Budget; None is ``RefinementOptions()``.
        seed: Seed of everything random here.

    Returns:
        The belief; ``belief.diagnostics`` says how far to trust it.

    Raises:
        ValueError: If shapes do not fit, there is no trial, the simulator is
            deterministic, it almost never gives a measurement that a trial gave, or an
            outcome is so far away that no parameters have a likelihood.
        MemoryError: If the memory does not suffice for so many parameters.

    References:
        Wood, Nature 2010; Price et al., J. Comp. Graph. Stat. 2018 (synthetic
        likelihood).

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
    prior = require_support(prior, enumerates=True)
    settings = RefinementOptions() if settings is None else settings
    action, outcome = _trials(action, x)
    enumeration = Enumeration.of(prior)
    if enumeration is not None:
        of_others = partial(refine, action=action, x=outcome, settings=settings)
        return enumerated(of_others, simulator, prior, enumeration, seed)
    hints = [] if start is None else start
    hints = [hints] if isinstance(hints, Distribution) else [*hints]
    problem = Problem(simulator, prior, action, outcome, hints, settings, seed)
    with single_thread():
        belief = refine_declared(problem, past)
        if belief is not None:
            return belief
        known = past if isinstance(past, Simulations) else None
        try:
            return _learned(problem, known)
        except RuntimeError as error:
            if "allocate memory" not in str(error):
                raise
            raise MemoryError(
                f"expected memory for a belief of {parameter_dim(prior)} parameters; "
                "got none left; fix the parameters that no trial informs, or lower "
                "num_histories"
            ) from error


def _learned(
    problem: Problem, past: Simulations | None, *, max_inflations: int = 3
) -> LearnedBelief:
    """Return the belief of a regression, of as wide a noise as the trials scatter.

    The noise is inflated at most ``max_inflations`` times.
    """
    settings, seed = problem.settings, problem.seed
    rng = np.random.default_rng(derive_seed(seed, "refine"))
    coordinates = PriorCoordinates(problem.prior, rng)
    least = 2 * fewest_rows(coordinates.dim)
    require(
        settings.num_histories >= least,
        f"at least {least} histories for {coordinates.dim} parameters",
        settings.num_histories,
        "raise num_histories",
    )
    pool = Pool(problem.simulator, [], settings.workers, past)
    budget = settings.num_histories * len(problem.action.unique(dim=0)) - len(pool)
    pairs = zip(problem.action, problem.x, strict=True)
    trials = [EmulatedTrial(action, x) for action, x in pairs]
    hints = coordinates.drawn_from(problem.hints, 1_000, seed=seed)
    near = np.concatenate([np.zeros((0, coordinates.dim)), *hints])
    inflation, first, sds = 1.0, None, np.zeros(1)
    for number in range(max_inflations + 1):
        emulation = Emulation(
            *(problem.prior, coordinates, pool, trials),
            *(fitted_summaries(None, problem.x), settings, EmulationSettings()),
            budget=max(budget, 0),
            near=near,
            seed=derive_seed(seed, "inflated", number) if number else seed,
        )
        belief, now = emulation.run(), emulation.contradiction()
        if now is None:
            break
        if first is None:
            first, sds = now, noise_sds(pool, trials)
        inflation *= now.inflation
        further = np.sqrt(max(inflation**2 - 1, 0.0)) * sds
        trials = [
            replace(trial, further_noise=sd)
            for trial, sd in zip(trials, further, strict=True)
        ]
        near = emulation.stages[-1].draws
    if first is not None:
        noted = replace(first, inflation=inflation).noted(belief.diagnostics)
        belief.diagnostics = noted
    belief.diagnostics = belief.diagnostics.extended(num_simulations=pool.num_drawn)
    belief.histories = pool.rows
    warn_missing(pool.num_missing, pool.num_drawn, "their rows")
    return belief


def _trials(action: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    action, x = torch.as_tensor(action), torch.as_tensor(x)
    require(
        action.ndim == 2 and x.ndim > 0 and len(action) == len(x) > 0,
        "action (t, action_dim) and x (t, *x_shape) with as many trials, at least one",
        f"{tuple(action.shape)} and {tuple(x.shape)}",
        "stack the trials along axis 0",
    )
    # Copies: a record keeps them, whatever becomes of the caller's.
    x = x.double().cpu().clone().reshape(len(x), *x.shape[1:] or (1,))
    return action.float().cpu().clone(), x
