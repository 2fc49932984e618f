"""Conditions of trials, as effects and simulators get them."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sbi_active.criticism.data.arrays import rows_at
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.effect import Context
from sbi_active.simulation import SimulatorModel
from sbi_active.simulation.conditions import typed


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
    return Context(
        index=trials.index[rows],
        times=times,
        inputs=rows_at(trials.inputs, rows),
        input_times=trials.input_times,
        start=rows_at(trials.start, rows),
    )


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
