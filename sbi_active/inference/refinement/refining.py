"""Refinement: the posterior of all trials, simulated where it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.inference.beliefs.belief import parameter_dim
from sbi_active.inference.beliefs.comparison import compare_orders
from sbi_active.inference.beliefs.priors import require_support
from sbi_active.inference.declared.contradiction import (
    MAX_INFLATIONS,
    Contradiction,
    contradiction_at,
)
from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.declared.simulated import ExactRecord, refine_exactly
from sbi_active.inference.declared.simulated_belief import SimulatedBelief
from sbi_active.inference.declared.simulated_likelihood import SimulatedLikelihood
from sbi_active.inference.refinement.confirmation import (
    Confirmation,
    by_likelihoods,
    by_replicates,
)
from sbi_active.inference.refinement.learned_belief import LearnedBelief
from sbi_active.inference.refinement.stages import MANY, Stages, Task
from sbi_active.inference.regression.histories import HistoryRecord
from sbi_active.seeding import derive_seed
from sbi_active.threads import single_thread


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
    (:func:`.importance_sample`), from the learned posterior or from the draws of the
    earlier call; beyond six parameters at once, from Gauss-Newton modes.

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
        MemoryError: If the memory does not suffice for so many parameters.

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
    task = Task(simulator, prior, action, outcome, [*hints], settings)
    with single_thread():
        belief, many = None, parameter_dim(prior) > MANY
        if many or outcome[0].numel() > settings.max_regressed:
            belief = task.many(past, seed, weighted=not many)
        if belief is None:
            belief = _within_memory(task, past, seed)
        if settings.check_order and isinstance(belief, LearnedBelief):
            other = replace(task, action=action.flip(0), outcome=outcome.flip(0))
            compare_orders(
                belief, Stages(other, None, derive_seed(seed, "reversed")).run()
            )
    return belief


def _within_memory(
    task: Task, past: HistoryRecord | None, seed: int
) -> LearnedBelief | SimulatedBelief:
    try:
        return _few(task, past, seed)
    except RuntimeError as error:
        if "allocate memory" not in str(error):
            raise
        raise MemoryError(
            f"expected memory for a belief of {parameter_dim(task.prior)} parameters; "
            "got none left; fix the parameters that no trial informs, or lower "
            "num_histories"
        ) from error


def _few(
    task: Task, past: HistoryRecord | None, seed: int
) -> LearnedBelief | SimulatedBelief:
    """Return the belief of a regression, or of what takes its place where it fails."""
    belief = _continued(task, past, seed)
    if belief is not None and _is_consistent(task, belief, seed):
        return belief
    stages = Stages(task, past, seed)
    belief = stages.run()
    contradiction = stages.contradiction()
    if contradiction is not None or not _is_consistent(task, belief, seed):
        wider = task.many(None, seed, weighted=True)
        return wider or _inflated(stages, belief, contradiction, seed)
    if isinstance(belief, SimulatedBelief):
        return belief
    belief.diagnostics = _confirmed(stages, belief, seed).noted(belief.diagnostics)
    if not belief.diagnostics.trustworthy:
        other = task.many(None, seed, weighted=True)
        if other is not None and other.diagnostics.trustworthy:
            return other
    return belief


def _continued(
    task: Task, past: HistoryRecord | None, seed: int
) -> SimulatedBelief | None:
    """Return the belief that goes on from the draws of a simulated likelihood."""
    if not isinstance(past, ExactRecord):
        return None
    if not past.leads_to(task.simulator, task.action, task.outcome):
        return None
    past.table.workers = task.settings.workers
    return refine_exactly(
        task.prior,
        SimulatedLikelihood(past.table, task.action, task.outcome),
        past.coordinates,
        first=[],
        histories=past,
        pool=past.pool,
        settings=task.settings,
        seed=seed,
    )


def _is_consistent(
    task: Task, belief: LearnedBelief | SimulatedBelief, seed: int
) -> bool:
    """Return whether the best draw of a simulated likelihood explains all trials."""
    if not isinstance(belief, SimulatedBelief):
        return True
    record = belief.histories
    assert isinstance(record, ExactRecord)
    best = record.coordinates.to_theta(
        record.pool.z[[record.pool.log_likelihood.argmax()]]
    )
    likelihood = SimulatedLikelihood(record.table, task.action, task.outcome)
    rng = np.random.default_rng(derive_seed(seed, "consistent"))
    level = task.settings.contradiction_level
    return contradiction_at(likelihood, best, level=level, rng=rng) is None


def _inflated(
    stages: Stages,
    belief: LearnedBelief | SimulatedBelief,
    contradiction: Contradiction | None,
    seed: int,
) -> LearnedBelief | SimulatedBelief:
    """Return a belief by simulations with noise as large as the trials scatter."""
    first, task = contradiction, stages.task
    histories, sds, inflation = belief.histories, stages.histories.noise_sds, 1.0
    for number in range(MAX_INFLATIONS):
        if first is None or contradiction is None:
            break
        inflation *= contradiction.inflation
        stages = Stages(
            task,
            None,
            derive_seed(seed, "inflated", number),
            further_noise=np.sqrt(max(inflation**2 - 1, 0.0)) * sds,
        )
        belief, contradiction = stages.run(), stages.contradiction()
    if first is not None:
        known = replace(first, inflation=inflation).noted(belief.diagnostics)
        belief.diagnostics = known
        belief.histories = histories  # those without the further noise
    return belief


def _confirmed(stages: Stages, belief: LearnedBelief, seed: int) -> Confirmation:
    """Compare a learned belief with simulations that it was not fitted to."""
    task, rng = stages.task, np.random.default_rng(derive_seed(seed, "confirm"))
    table = task.table(stages.coordinates)
    if table is not None:
        likelihood = SimulatedLikelihood(table, task.action, task.outcome)
        return by_likelihoods(stages, belief, likelihood, rng)
    return by_replicates(stages, belief, rng)


def _trials(action: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    action, x = torch.as_tensor(action), torch.as_tensor(x)
    if action.ndim != 2 or x.ndim < 1 or len(action) != len(x) or len(action) == 0:
        raise ValueError(
            "expected action (t, action_dim) and x (t, *x_shape) with as many trials, "
            f"at least one; got {tuple(action.shape)} and {tuple(x.shape)}; stack "
            "the trials along axis 0"
        )
    return action.float().cpu(), x.double().cpu().reshape(len(x), *x.shape[1:] or (1,))
