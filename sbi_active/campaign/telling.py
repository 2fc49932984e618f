"""Checks of a told trial before it is recorded."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.actions import ActionSpace
from sbi_active.arrays import measured
from sbi_active.campaign.state import UNSCORED, CampaignState, Status, Trial
from sbi_active.inference.rounds.condition import action_rows, outcome_rows
from sbi_active.messages import warn

LOST = "its record was lost"  # reason of a trial that a repair gave up
MOST_LOST = 10_000  # trials that a repair gives up at once; the index is damaged beyond
LARGEST = torch.finfo(torch.float32).max


def told_trial(
    state: CampaignState,
    x: Any,
    *,
    trial: Trial | int | None,
    action: Any,
    status: Status,
    x_shape: torch.Size,
    actions: ActionSpace,
) -> Trial:
    """Return the record of a trial as told; the recorded one where nothing is new.

    Args:
        state: State of the campaign.
        x: The outcome.
        trial: The trial, its index, or None for the pending one.
        action: The executed one; None is the one asked for.
        status: Status of the trial, as told.
        x_shape: Shape of an outcome.
        actions: Action space of the campaign; an action executed outside of it is
            warned of.

    Raises:
        ValueError: If there is no such trial, or numbers or shapes do not fit.
    """
    if status not in ("ok", "invalid", "missing"):
        raise ValueError(
            f"expected status 'ok', 'invalid' or 'missing'; got {status!r}; choose one "
            "of these, or withdraw(trial)"
        )
    outcome = outcome_told(x, status, x_shape)
    if outcome is not None and not bool(outcome.isfinite().any()):
        status = "invalid"
    target = _trial_to_tell(
        state, trial, outcome, status, has_action=action is not None
    )
    executed = (
        target.action if action is None else _action_told(action, actions.action_dim)
    )
    if not bool(actions.contains(executed)):
        warn(
            f"SA202 the executed action {executed.tolist()} is not in {actions}; it "
            "is simulated where it was executed",
            stacklevel=5,
        )
    told = replace(target, action=executed, x=outcome, status=status)
    if target.status != "pending":
        told = replace(told, reason="", **UNSCORED)
        return target if same_outcome(target, told) else told
    return told


def find_trial(state: CampaignState, trial: Trial | int) -> Trial:
    """Return the recorded trial of an index.

    Raises:
        ValueError: If there is none.
    """
    try:
        index = trial.index if isinstance(trial, Trial) else operator.index(trial)
    except TypeError:
        index = -1
    if not 0 <= index < len(state.trials):
        raise ValueError(
            f"expected the index of one of {len(state.trials)} trials; got "
            f"{trial if index < 0 else index}; pass the trial that ask() returned"
        )
    return state.trials[index]


def recorded(state: CampaignState, facts: Mapping[str, Any]) -> Trial:
    """Return the record of a trial as the log has it.

    Earlier findings stay if the trial is the same as before.

    Args:
        state: State of the campaign.
        facts: Fields of :class:`.Trial`, its index among them.

    """
    index = facts["index"]
    if index > len(state.trials) + MOST_LOST:
        raise ValueError(f"expected a trial after {len(state.trials)}; got {index}")
    while index > len(state.trials):  # what a repair of the log gave up
        gap = Trial(len(state.trials), torch.full_like(facts["action"], torch.nan))
        state.record(replace(gap, status="withdrawn", reason=LOST))
    if index == len(state.trials):
        return Trial(**facts)
    before = find_trial(state, index)
    after = replace(before, **facts)
    if before.status == "pending" or same_outcome(before, after):
        return after
    return replace(after, **UNSCORED)


def outcome_told(x: Any, status: Status, x_shape: torch.Size) -> Tensor | None:
    """Return the outcome, NaN where not measured, shape x_shape.

    It is None for a missing trial. Infinite numbers count as not measured.

    Raises:
        ValueError: If there is no outcome, or one of another shape, or what was told
            are no numbers that float32 holds.
    """
    if status == "missing":
        return None
    if status == "invalid":  # numbers told along with it are no measurement
        return torch.full(x_shape, torch.nan)
    if x is None:
        raise ValueError(
            "expected the outcome x; got None; tell(x), or tell(status=...) with "
            "'invalid' or 'missing' where there is none"
        )
    tensor = _numbers(x, "x")
    if tensor.shape != x_shape and tensor.numel() == x_shape.numel() == 1:
        tensor = tensor.reshape(x_shape)
    rows = outcome_rows(tensor, x_shape)
    if len(rows) != 1:
        raise ValueError(
            f"expected one outcome of shape {tuple(x_shape)}; got {len(rows)}; tell "
            "one trial at a time"
        )
    return _measured(rows[0])


def _measured(x: Tensor) -> Tensor:
    """Return x with NaN for infinite numbers, which no sensor measures."""
    infinite = x.isinf()
    if not bool(infinite.any()):
        return x
    warn(
        f"SA201 {int(infinite.sum())} of {x.numel()} told numbers are infinite and "
        "count as not measured; pass NaN where a sensor gave nothing",
        stacklevel=7,
    )
    return torch.where(infinite, torch.nan, x)


def same_outcome(a: Trial, b: Trial) -> bool:
    """Return whether two records of a trial agree."""
    if a.status != b.status or not torch.equal(a.action, b.action):
        return False
    if a.x is None or b.x is None:
        return a.x is b.x
    # Bit for bit: amperes and farads have no absolute tolerance.
    same = (a.x == b.x) | (a.x.isnan() & b.x.isnan())
    return a.x.shape == b.x.shape and bool(same.all())


def _trial_to_tell(
    state: CampaignState,
    trial: Trial | int | None,
    outcome: Tensor | None,
    status: Status,
    *,
    has_action: bool,
) -> Trial:
    """Return the trial that is meant, a new one where none is pending."""
    if isinstance(trial, Trial) and trial.index == len(state.trials):
        return trial
    if trial is not None:
        return find_trial(state, trial)
    pending = [t for t in state.trials if t.status == "pending"]
    if pending:
        return pending[0]
    if has_action:
        return Trial(len(state.trials), torch.empty(0))
    if state.trials:  # the last one, told twice
        last = state.trials[-1]
        if same_outcome(last, replace(last, x=outcome, status=status)):
            return last
    raise ValueError(
        "expected a pending trial; got none; ask() first, pass action= to record a "
        "trial that was not asked for, or trial= to correct one"
    )


def _action_told(action: Any, action_dim: int) -> Tensor:
    numbers = _numbers(action, "the action")
    finite = numbers.isfinite() & (numbers.abs() <= LARGEST)
    if not bool(finite.all()):
        raise ValueError(
            f"expected a finite action of real numbers; got {numbers.tolist()}; pass "
            "the action that was executed, or status='missing' where it is unknown"
        )
    return action_rows(numbers, action_dim, num_rows=1)[0]


def _numbers(told: Any, name: str) -> Tensor:
    """Return numbers apart from what the caller may still change."""
    listed = isinstance(told, Sequence | np.ndarray)
    if listed and None in np.array(told, dtype=object).ravel().tolist():
        raise ValueError(
            f"expected {name} of real numbers; got {told!r:.80}; pass NaN where a "
            "sensor gave nothing"
        )
    return measured(told, name=name)
