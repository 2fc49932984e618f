"""Checks before models are compared with trials."""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.callers import stack_level
from sbi_active.criticism.data.input_series import require_covered
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.augmented import NUM_CHECKED, AugmentedSimulator
from sbi_active.criticism.effects.declarations import require_distinct, require_nested
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.effects.trial_conditions import (
    conditions_for,
    conditions_of_trials,
    has_own_times,
)
from sbi_active.criticism.results import CATCH_ALLS, NONE
from sbi_active.inference.beliefs.enumerated import Enumeration
from sbi_active.messages import warn
from sbi_active.seeding import forked_generators
from sbi_active.simulation import SimulatorModel
from sbi_active.simulation.noise.estimation import estimate_noise


def with_noise(
    model: SimulatorModel,
    prior: Distribution,
    trials: Trials,
    *,
    # a choice: two degrees of freedom for the spread
    fewest_repeats: int = 3,
) -> SimulatorModel:
    """Return the model with noise from repeats where it is deterministic without."""
    theta, action = _some_rows(prior, trials)
    run = _conditions(model, trials, theta)
    if model.noise is not None or not model.is_deterministic(theta, action, **run):
        return model
    fit = trials.fit
    first = torch.where(fit.repeat_of < 0, torch.arange(len(fit)), fit.repeat_of)
    groups = [fit.x[first == i] for i in first.unique()]
    most = max(len(group) for group in groups)
    if most < fewest_repeats:
        raise ValueError(
            "expected measurement noise, declared or estimated from at least "
            f"{fewest_repeats} repeats of one action; got a deterministic simulator "
            f"without noise and at most {most} trials of one action, so that nothing "
            "tells noise from effect; declare SimulatorModel(fn, noise=...)"
        )
    repeated = [group for group in groups if len(group) > 1]
    noisy = copy.copy(model)
    has_time = model.sample_times is not None
    noisy.noise = estimate_noise(
        repeated,
        kind="autocorrelated" if has_time else "gaussian",
        times=model.sample_times,
        pooled=True,
    )
    return noisy


def digest(
    model: SimulatorModel, prior: Distribution, effects: Sequence[Effect]
) -> str:
    """Return a hash of the noise, the effects and draws of all priors."""
    words = [repr(model.noise)]
    with forked_generators(0, "digest"):
        words.append(repr(prior.sample(torch.Size([8])).tolist()))
        for e in effects:
            words.append(f"{e.name}|{e.hook}|{e.family}|{e.scope}|{e.null}")
            words.append(repr(e.sample(8).tolist()))
    return hashlib.sha256("\n".join(words).encode()).hexdigest()[:16]


def require_fitting(
    model: SimulatorModel,
    prior: Distribution,
    trials: Trials,
    effects: Sequence[Effect],
    actions: ActionSpace | None,
) -> None:
    """Raise if the parts of a loop do not fit together."""
    if Enumeration.of(prior) is not None:
        raise ValueError(
            "expected a prior of continuous parameters; got one with parameters of a "
            "few values; declare the choice as an Effect, which is compared with none"
        )
    own = model.parameter_names
    default = [f"theta_{i + 1}" for i in range(prior.event_shape[0])]
    require_distinct(effects, default if own is None else own)
    require_nested(effects)
    reserved = (NONE, *CATCH_ALLS)
    taken = [e.name for e in effects if e.name in reserved]
    if taken:
        raise ValueError(
            f"expected effects not named {', '.join(reserved)}; got {taken[0]!r}; "
            "choose another name: noise inflation is tried in any case"
        )
    num = int(trials.fit.valid.sum())
    if num < 2:
        raise ValueError(
            f"expected at least two valid trials to fit; got {num}; measure more, "
            "since one trial fits any model"
        )
    if actions is not None and actions.action_dim != trials.action.shape[1]:
        raise ValueError(
            f"expected actions of dimension {trials.action.shape[1]}, that of the "
            f"trials; got {actions.action_dim}; give the space they were drawn from"
        )
    _require_no_labels_changed(trials, effects)
    _warn_unused(model, trials)
    if trials.inputs is not None and has_own_times(model, trials):
        times, grid = model.sample_times, trials.input_times
        assert times is not None
        assert grid is not None
        require_covered(
            times[None], dict.fromkeys(trials.inputs, grid[None]), trials.names
        )
    if actions is not None:
        _warn_outside(trials, actions)
    theta, action = _some_rows(prior, trials)
    if model.noise is not None:
        x = model.mean(theta, action, **_conditions(model, trials, theta))
        if not bool(x.isfinite().any()):
            raise ValueError(
                "expected a simulator that gives numbers at the trials' actions; got "
                "NaN or inf throughout; check its units and those of the actions"
            )
    # Compares every effect with the simulator at its null.
    context = conditions_of_trials(trials, _some_trials(trials), model)
    AugmentedSimulator(model, effects, check=(theta, action, context))


def _require_no_labels_changed(trials: Trials, effects: Sequence[Effect]) -> None:
    """Raise if an effect would change an action that is only a trial's number."""
    for effect in effects:
        if effect.hook == "action" and trials.action_is_label:
            raise ValueError(
                "expected effects on the inputs where the action is the trial's "
                f"number; got {effect.name!r} on the action; declare hook='input'"
            )


def require_warm_up(warm_up: float, trials: Trials, effects: Sequence[Effect]) -> float:
    """Return the time in which trials that were not fitted tell of their nuisances.

    Raises:
        ValueError: If it is negative, there is nothing to tell of, x has no times, or a
            trial is no longer than that.
    """
    if not 0 <= warm_up < float("inf"):
        raise ValueError(
            f"expected warm_up >= 0; got {warm_up}; pass a time in the unit of the "
            "sample times, or 0"
        )
    if warm_up == 0:
        return 0.0
    if not any(e.scope == "trial" for e in effects):
        raise ValueError(
            f"expected effects of scope 'trial' with warm_up = {warm_up:g}; got none; "
            "declare the nuisances that the first samples of a trial tell of, or leave "
            "warm_up out"
        )
    times = trials.sample_times
    if times is None:
        raise ValueError(
            f"expected sample_times with warm_up; got warm_up = {warm_up:g} and none; "
            "give Trials(sample_times=...)"
        )
    stamps = times.expand(len(trials), -1).nan_to_num(-torch.inf)
    span = stamps.amax(1) - times.expand(len(trials), -1)[:, 0]
    short = [trials.names[i] for i in range(len(trials)) if span[i] <= warm_up]
    if short:
        raise ValueError(
            f"expected trials longer than warm_up = {warm_up:g}; got "
            f"{float(span.min()):g} in trial {short[0]}; pass a shorter warm_up, in "
            "the unit of the sample times"
        )
    return float(warm_up)


def _warn_unused(model: SimulatorModel, trials: Trials) -> None:
    """Warn of what was recorded and the simulator's function does not take."""
    for name in ("inputs", "start"):
        if getattr(trials, name) is not None and name not in model.conditions:
            warn(
                f"SA210 the trials have {name}, and the simulator's function takes no "
                f"argument {name!r}: they are not used; write fn(theta, action, *, "
                f"{name})",
                stacklevel=stack_level(),
            )


def _warn_outside(trials: Trials, actions: ActionSpace) -> None:
    """Warn of actions that are not permitted; they are simulated all the same."""
    dtype = torch.get_default_dtype()
    outside = ~torch.as_tensor(actions.contains(trials.action.to(dtype)))
    if not bool(outside.any()):
        return
    places = outside.nonzero()[:, 0].tolist()
    warn(
        f"SA202 the executed action {trials.action[places[0]].tolist()} of trial "
        f"{trials.names[places[0]]} is not in {actions} ({trials.called(places)}); it "
        "is simulated where it was executed",
        stacklevel=stack_level(),
    )


def _conditions(model: SimulatorModel, trials: Trials, theta: Tensor) -> dict[str, Any]:
    """Return how some trials were run, as far as the model's function takes it."""
    return conditions_for(model, trials, _some_trials(trials), theta.dtype)


def _some_trials(trials: Trials) -> Tensor:
    """Return positions of trials for a few rows, shape (16,), none with padding."""
    whole = torch.arange(len(trials))
    if trials.sample_times is not None:
        times = trials.sample_times.expand(len(trials), -1)
        sampled = times.isfinite().sum(1)
        whole = whole[sampled == sampled.max()]
    return whole[torch.arange(NUM_CHECKED) % len(whole)]


def _some_rows(prior: Distribution, trials: Trials) -> tuple[Tensor, Tensor]:
    with forked_generators(0, "check"):
        theta = prior.sample((NUM_CHECKED,))  # type: ignore[arg-type]
    return theta, trials.action[_some_trials(trials)].to(theta.dtype)
