"""Conditions of trials that were run, and of those at other actions."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sbi_active.actions import ActionSpace, DiscreteActions
from sbi_active.criticism.data.input_series import held_at
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.effect import Context
from sbi_active.expected import require
from sbi_active.simulation import SimulatorModel
from sbi_active.simulation.conditions import at_rows, typed


def conditions_of_trials(
    trials: Trials, rows: Tensor, model: SimulatorModel
) -> Context:
    """Return the conditions of each row's trial.

    Args:
        trials: Measured trials.
        rows: Position of each row's trial, shape (n,).
        model: Simulator. If it has sample times of its own and takes no others, x is
            simulated at these.
    """
    times = None if has_own_times(model, trials) else trials.sample_times
    if times is not None and times.ndim == 2:
        times = _held(times)[rows]
    own = {name: getattr(trials, name) for name in ("index", "inputs", "start")}
    return Context(times=times, input_times=trials.input_times, **at_rows(own, rows))


def conditions_for(
    model: SimulatorModel, trials: Trials, rows: Tensor, dtype: torch.dtype
) -> dict[str, Any]:
    """Return conditions of trials as keyword arguments that a model's function takes.

    Args:
        model: The simulator.
        trials: Measured trials.
        rows: Position of each row's trial, shape (n,).
        dtype: Type of the tensors.
    """
    context = conditions_of_trials(trials, rows, model)
    return typed(context.told(model.conditions), dtype)


def has_own_times(model: SimulatorModel, trials: Trials) -> bool:
    """Return whether x is simulated at the model's times, not at the trials'."""
    asked = "times" in model.conditions and trials.sample_times is not None
    return model.sample_times is not None and not asked


def _held(times: Tensor) -> Tensor:
    """Return times, shape (t, k), with the last of each row in place of its padding."""
    last = times.nan_to_num(-torch.inf).amax(-1, keepdim=True)
    last = last.where(last.isfinite(), torch.zeros_like(last))
    return times.where(times.isfinite(), last)


def with_known_inputs(
    model: SimulatorModel, trials: Trials, actions: ActionSpace
) -> ActionSpace:
    """Return the permitted actions that could be simulated.

    If inputs over time were recorded and the model has no signals, the inputs at
    another action are not known: only actions of recorded trials remain, with their
    inputs.

    Args:
        model: The simulator.
        trials: Measured trials.
        actions: The permitted ones.
    """
    if trials.inputs is None or model.inputs is not None:
        return actions
    recorded = trials.action.unique(dim=0)
    kept = recorded[actions.contains(recorded.float())]
    kept = kept if len(kept) else recorded
    return DiscreteActions(kept, names=actions.names, units=actions.units)


def are_known(model: SimulatorModel, trials: Trials, action: Tensor) -> Tensor:
    """Return at which actions, shape (a, action_dim), trials can be simulated, (a,)."""
    is_free = trials.inputs is None or model.inputs is not None
    return _same(trials, action).any(1) | is_free


def unmeasured(
    model: SimulatorModel, trials: Trials, action: Tensor, index: Tensor
) -> Trials:
    """Return trials at some actions, with all numbers that any trial has.

    Inputs and start state are those of the first trial of the action; at an action that
    none has, inputs are the model's signals and the start is the mean of those
    measured.

    Args:
        model: The simulator.
        trials: Measured trials.
        action: Actions, shape (a, action_dim).
        index: Place of each trial in the order of execution, shape (a,).

    Raises:
        ValueError: If inputs were recorded, and none at some of these actions.
    """
    same = _same(trials, action)
    found, first = same.any(1), same.int().argmax(1)
    inputs = trials.inputs and at_rows(trials.inputs, first)
    if inputs is not None and model.inputs is not None:
        assert trials.input_times is not None
        signals = model.inputs.inputs(action.double())
        expected = f"the inputs of the model's signals, {', '.join(signals)}"
        got = ", ".join(inputs)
        require({*signals} == {*inputs}, expected, got, "name them alike")
        played = held_at(signals, model.inputs.input_times, trials.input_times)
        known = found[:, None]
        inputs = {name: inputs[name].where(known, played[name]) for name in inputs}
    elif inputs is not None:
        lost, advice = action[~found].tolist(), "permit actions of the trials alone"
        require(not lost, "actions whose inputs were recorded", lost, advice)
    x, times = trials.template()
    start = trials.start and {
        name: part[first].where(found, part.mean())
        for name, part in trials.start.items()
    }
    new = Trials(
        action.double(),
        x.expand(len(action), *x.shape),
        index=index,
        sample_times=times,
        inputs=inputs,
        input_times=trials.input_times,
        start=start,
    )
    new.action_is_label = trials.action_is_label
    return new


def _same(trials: Trials, action: Tensor) -> Tensor:
    """Return a mask of the trials that have each action, shape (a, t)."""
    own, asked = trials.action.double(), action.double()
    # As far as single precision tells.
    return torch.isclose(asked[:, None], own[None], rtol=1e-5, atol=1e-7).all(-1)
