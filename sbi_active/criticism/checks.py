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
from sbi_active.criticism.data.columns import split
from sbi_active.criticism.data.input_series import require_covered
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.augmented import NUM_CHECKED, AugmentedSimulator
from sbi_active.criticism.effects.effect import Effect, require_distinct, require_nested
from sbi_active.criticism.effects.trial_conditions import (
    conditions_for,
    conditions_of_trials,
    has_own_times,
)
from sbi_active.criticism.results import CATCH_ALLS, NONE
from sbi_active.expected import require
from sbi_active.inference.beliefs.enumerated import Enumeration
from sbi_active.messages import warn
from sbi_active.seeding import forked_generators
from sbi_active.simulation import SimulatorModel
from sbi_active.simulation.noise.estimation import estimate_noise


def require_classes(model: Any, prior: Any, trials: Any, effects: Any) -> None:
    """Raise a TypeError if a part of a loop is of another class."""
    own = isinstance(effects, Sequence) and all(isinstance(e, Effect) for e in effects)
    for name, part, fits in (
        ("model, a SimulatorModel", model, isinstance(model, SimulatorModel)),
        ("prior, a Distribution", prior, isinstance(prior, Distribution)),
        ("trials, as Trials", trials, isinstance(trials, Trials)),
        ("effects, a list of Effect", effects, own),
    ):
        if not fits:
            raise TypeError(f"expected {name}; got {part!r:.80}; pass one")


def with_noise(
    model: SimulatorModel,
    prior: Distribution,
    trials: Trials,
    *,
    # a choice: two degrees of freedom for the spread
    fewest_repeats: int = 3,
) -> SimulatorModel:
    """Return the model with noise from repeats where it is deterministic without."""
    if not lacks_noise(model, prior, trials):
        return model
    fit = trials.fit
    first = torch.where(fit.repeat_of < 0, torch.arange(len(fit)), fit.repeat_of)
    groups = [fit.x[first == i] for i in first.unique()]
    most = max(map(len, groups))
    require(
        most >= fewest_repeats,
        "measurement noise, declared or estimated from at least "
        f"{fewest_repeats} repeats of one action",
        f"a deterministic simulator without noise and at most {most} trials of one "
        "action, so that nothing tells noise from effect",
        "declare SimulatorModel(fn, noise=...)",
    )
    noisy = copy.copy(model)
    noisy.noise = estimate_noise(
        [group for group in groups if len(group) > 1],
        kind="gaussian" if model.sample_times is None else "autocorrelated",
        times=model.sample_times,
        pooled=True,
    )
    return noisy


def lacks_noise(model: SimulatorModel, prior: Distribution, trials: Trials) -> bool:
    """Return whether a simulator is deterministic, and no noise is declared."""
    theta, action, at = _some_rows(prior, trials)
    run = conditions_for(model, trials, at, theta.dtype)
    return model.noise is None and model.is_deterministic(theta, action, **run)


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
    require(
        Enumeration.of(prior) is None,
        "a prior of continuous parameters",
        "one with parameters of a few values",
        "declare the choice as an Effect, which is compared with none",
    )
    own = model.parameter_names
    default = [f"theta_{i + 1}" for i in range(prior.event_shape[0])]
    require_distinct(effects, default if own is None else own)
    require_nested(effects)
    reserved = (NONE, *CATCH_ALLS)
    expected = f"effects not named {', '.join(reserved)}"
    for effect in effects:
        is_free = effect.name not in reserved
        require(is_free, expected, repr(effect.name), "choose another name")
        require(
            not (effect.hook == "action" and trials.action_is_label),
            "effects on the inputs where the action is the trial's number",
            f"{effect.name!r} on the action",
            "declare hook='input'",
        )
    num, advice = int(trials.fit.valid.sum()), "measure more: one trial fits any model"
    require(num > 1, "at least two valid trials to fit", num, advice)
    if actions is not None:
        dim, own_dim = actions.action_dim, trials.action.shape[1]
        expected = f"actions of dimension {own_dim}, that of the trials"
        require(dim == own_dim, expected, dim, "give the space they were drawn from")
    labels = model.channel_names, trials.channel_labels
    names, given = ([split(label)[0] for label in own or ()] for own in labels)
    require(
        names == given or sorted(names) != sorted(given),
        f"x in the order of the simulator's channels, {', '.join(names)}",
        ", ".join(given),
        "name the columns in that order",
    )
    for name in ("inputs", "start"):
        if getattr(trials, name) is not None and name not in model.conditions:
            warn(
                f"SA210 the trials have {name}, and the simulator's function takes no "
                f"argument {name!r}: they are not used; write fn(theta, action, *, "
                f"{name})",
            )
    if trials.inputs is not None and has_own_times(model, trials):
        times, grid = model.sample_times, trials.input_times
        assert times is not None
        assert grid is not None
        stamps = dict.fromkeys(trials.inputs, grid.expand(len(trials), -1))
        require_covered(times.expand(len(trials), -1), stamps, trials.names)
    if actions is not None:
        _warn_outside(trials, actions)
    theta, action, at = _some_rows(prior, trials)
    if model.noise is not None:
        x = model.mean(theta, action, **conditions_for(model, trials, at, theta.dtype))
        require(
            bool(x.isfinite().any()),
            "a simulator that gives numbers at the trials' actions",
            "NaN or inf throughout",
            "check its units and those of the actions",
        )
    # Compares every effect with the simulator at its null.
    context = conditions_of_trials(trials, at, model)
    AugmentedSimulator(model, effects, check=(theta, action, context))


def require_warm_up(warm_up: float, trials: Trials, effects: Sequence[Effect]) -> float:
    """Return the time in which trials that were not fitted tell of their nuisances.

    Raises:
        ValueError: If it is negative, there is nothing to tell of, x has no times, or a
            trial is no longer than that.
    """
    is_time, given = 0 <= warm_up < float("inf"), f"warm_up = {warm_up:g}"
    require(is_time, "warm_up >= 0", warm_up, "pass a time, or 0")
    if warm_up == 0:
        return 0.0
    require(
        any(e.scope == "trial" for e in effects),
        f"effects of scope 'trial' with {given}",
        "none",
        "declare the nuisances that the first samples of a trial tell of, or leave "
        "warm_up out",
    )
    times = trials.sample_times
    advice = "give Trials(sample_times=...)"
    expected, got = "sample_times with warm_up", f"{given} and none"
    require(times is not None, expected, got, advice)
    stamps = torch.as_tensor(times).expand(len(trials), -1)
    span = stamps.nan_to_num(-torch.inf).amax(1) - stamps[:, 0]
    for name, own in zip(trials.names, span.tolist(), strict=True):
        expected, got = f"trials longer than {given}", f"{own:g} in trial {name}"
        advice = "pass a shorter warm_up, in the unit of the sample times"
        require(own > warm_up, expected, got, advice)
    return float(warm_up)


def _warn_outside(trials: Trials, actions: ActionSpace) -> None:
    """Warn of actions that are not permitted; they are simulated all the same."""
    dtype = torch.get_default_dtype()
    outside = ~torch.as_tensor(actions.contains(trials.action.to(dtype)))
    if places := outside.nonzero()[:, 0].tolist():
        warn(
            f"SA202 the executed action {trials.action[places[0]].tolist()} of trial "
            f"{trials.names[places[0]]} is not in {actions} ({trials.called(places)}); "
            "it is simulated where it was executed",
        )


def _some_rows(prior: Distribution, trials: Trials) -> tuple[Tensor, Tensor, Tensor]:
    """Return parameters, actions, and positions of these trials, none with padding."""
    whole = torch.arange(len(trials))
    if trials.sample_times is not None:
        sampled = trials.sample_times.expand(len(trials), -1).isfinite().sum(1)
        whole = whole[sampled == sampled.max()]
    at = whole[torch.arange(NUM_CHECKED) % len(whole)]
    with forked_generators(0, "check"):
        theta = prior.sample(torch.Size([NUM_CHECKED]))
    return theta, trials.action[at].to(theta.dtype), at
