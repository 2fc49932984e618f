"""Trials that are asked for and told, as text and as JSON, without importing torch."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sbi_active.cli.options import number_of, numbers_in, numbers_of
from sbi_active.cli.output import Answer
from sbi_active.cli.record import shaped, sum_up

MANY = 5  # numbers, more than somebody types


def ask(campaign: Any, *, target: str) -> Answer:
    """Design the next trial, or show the pending one."""
    trial = campaign.ask(target=target)
    gain, error = None, None
    if trial.design is not None:
        index = trial.design.index
        gain = float(trial.design.expected_information_gain[index])
        error = float(trial.design.standard_error[index])
    found = {"expected_information_gain": gain, "standard_error": error}
    data = {**described(campaign, trial), "target": trial.target, **found}
    lines = [f"trial {trial.index}: {_place(data)}"]
    if gain is not None:
        lines += [f"it is expected to tell {gain:.2f} nats about {trial.target}"]
    num = math.prod(campaign.x_shape)
    numbers = "--file X.csv" if num > MANY else " ".join("X" * num)
    lines += [f"then: sbi-active tell {campaign.directory} {numbers}"]
    return Answer(data, "\n".join(lines))


def tell(
    campaign: Any, *, trial: int | None, action: str | None, **outcome: Any
) -> Answer:
    """Record what a trial gave; it is on the disk when this ends."""
    if trial is not None:
        _require_trial(campaign, trial)
    x, status = _outcome(campaign, **outcome)
    executed = None if action is None else numbers_of(action)
    told = campaign.tell(x, trial=trial, action=executed, status=status)
    return _confirmed(campaign, told)


def correct(
    campaign: Any, *, trial: int, action: str | None, reason: str, **outcome: Any
) -> Answer:
    """Replace what was told of a trial."""
    _require_trial(campaign, trial)
    executed = None if action is None else numbers_of(action)
    is_of_action = executed is not None and not any(outcome.values())
    x, status = (None, "ok") if is_of_action else _outcome(campaign, **outcome)
    what = {"action": executed, "status": status, "reason": reason}
    return _confirmed(campaign, campaign.correct(trial, x, **what))


def withdraw(campaign: Any, *, trial: int, reason: str) -> Answer:
    """Take a trial out."""
    _require_trial(campaign, trial)
    return _confirmed(campaign, campaign.withdraw(trial, reason=reason))


def update(campaign: Any) -> Answer:
    """Bring the belief up to date with the trials told so far."""
    campaign.update()
    return status(campaign)


def status(campaign: Any) -> Answer:
    """Print the trials, the belief and the health."""
    data = getattr(campaign, "status", None) or found_in(campaign)
    trials, belief = data["trials"], data["belief"]
    pending = sum(trial["status"] == "pending" for trial in trials)
    waits = ", one pending" if pending else ""
    head = f"{data['method']}, {len(trials) - pending} trials{waits}"
    together = f"; {belief['combinations']}" if belief["combinations"] else ""
    lines = [f"{head}, health {data['health']}{together}"]
    for trial in trials:
        gained, reason = trial["information_gained"], trial["reason"]
        gain = "" if gained is None else f"  {gained:.2f} nats"
        why = f"  ({reason})" if reason else ""
        shown = f"{_place(trial)}{_short(trial['x'], '  x = ')}{gain}{why}"
        lines.append(f"{trial['trial']:>4}  {trial['status']:<9} {shown}")
    for name, entry in belief["parameters"].items():
        lines.append(f"{name:>12} = {entry['mean']:.4g} +- {entry['sd']:.2g}")
    lines += [f"note: {w}" for w in belief["warnings"]]
    if data["not_in_belief"]:
        waiting = data["not_in_belief"]
        lines.append(f"not in the belief yet: {waiting}; run sbi-active update")
    return Answer(data, "\n".join(lines))


def sum_up_campaign(campaign: Any) -> None:
    """Leave a summary in the folder of a campaign that holds the right to write."""
    with contextlib.suppress(Exception):  # a belief without moments has no summary
        known = {
            "status": found_in(campaign),
            "x_shape": [*campaign.x_shape],
            "actions": _limits(campaign.actions),
            "names": [*campaign.actions.names],
            "units": [*campaign.actions.units],
            "processed": [*campaign.state.processed],
        }
        sum_up(campaign.directory, known)


def _limits(actions: Any) -> dict[str, Any] | None:
    """Return which actions are permitted as JSON; None where only the space can say."""
    kind = type(actions).__name__
    if kind == "BoxActions":
        return {
            "kind": "box",
            "low": actions.low.tolist(),
            "high": actions.high.tolist(),
        }
    listed = kind == "DiscreteActions"
    return {"kind": "list", "values": actions.values.tolist()} if listed else None


def found_in(campaign: Any) -> dict[str, Any]:
    """Return the trials, the belief and the health of a campaign as JSON."""
    belief = campaign.belief
    mean, variance = belief.mean.reshape(-1), belief.variance.reshape(-1)
    names = campaign.parameter_names or [f"theta_{k + 1}" for k in range(len(mean))]
    diagnostics = getattr(belief, "diagnostics", None)
    said = [] if diagnostics is None else [*diagnostics.warnings]
    together = getattr(diagnostics, "combinations", None)
    waiting = [t.index for t in campaign.history if not campaign.contains(t)]
    return {
        "method": campaign.state.method,
        "trials": [described(campaign, trial) for trial in campaign.state.trials],
        "belief": {
            "parameters": {
                name: {"mean": float(m), "sd": float(v) ** 0.5}
                for name, m, v in zip(names, mean, variance, strict=True)
            },
            "trustworthy": None if diagnostics is None else diagnostics.trustworthy,
            "warnings": said,
            "codes": [warning.code for warning in said],
            "combinations": str(together) if together else None,
        },
        "health": campaign.health,
        "not_in_belief": waiting,
    }


def described(campaign: Any, trial: Any) -> dict[str, Any]:
    """Return a trial as JSON, but for NaN."""
    return {
        "trial": trial.index,
        "status": trial.status,
        "action": trial.action.tolist(),
        "names": [*campaign.actions.names],
        "units": [*campaign.actions.units],
        "x": None if trial.x is None else trial.x.flatten().tolist(),
        "information_gained": trial.information_gained,
        "surprise": trial.surprise,
        "reason": trial.reason,
    }


def _confirmed(campaign: Any, trial: Any) -> Answer:
    data = trial if isinstance(trial, dict) else described(campaign, trial)
    what = f"{data['status']} at {_place(data)}{_short(data['x'], ', x = ')}"
    text = f"trial {data['trial']}: {what}\nnext: sbi-active ask {campaign.directory}"
    return Answer(data, text)


def _outcome(
    campaign: Any, *, x: Sequence[str], file: Path | None, **flags: bool
) -> tuple[Any, Any]:
    """Return what was measured, in the shape of the simulator's x, and its status."""
    said = [name for name, value in flags.items() if value]
    if len(said) + bool(x) + (file is not None) > 1:
        raise ValueError(
            "expected numbers, --file, --invalid or --missing; got several; write one"
        )
    if said:
        return None, said[0]
    if file is not None:
        numbers = numbers_in(file)
    else:
        numbers = [number_of(cell, is_outcome=True) for cell in x]
    shape = tuple(campaign.x_shape)
    if len(numbers) != math.prod(shape):
        raise ValueError(
            f"expected {math.prod(shape)} numbers, as the simulator gives; got "
            f"{len(numbers)}; write nan for one that was not measured, --invalid where "
            "the trial gave none, or --missing where it failed"
        )
    if all(map(math.isnan, numbers)):
        raise ValueError(
            "expected a number that was measured; got none; write --invalid where the "
            "trial ran and gave none, which tells about the parameters, or --missing "
            "where it failed"
        )
    return shaped(numbers, shape), "ok"


def _require_trial(campaign: Any, number: int) -> None:
    count = len(campaign.state.trials)
    if not 0 <= number < count:
        raise ValueError(
            f"expected a trial from 0 to {count - 1}; got {number}; see sbi-active "
            "status"
        )


def _place(trial: Mapping[str, Any]) -> str:
    """Return a trial's action with names and units."""
    parts = zip(trial["names"], trial["action"], trial["units"], strict=True)
    return ", ".join(f"{n} = {v:.6g}{f' {u}' if u else ''}" for n, v, u in parts)


def _short(x: Sequence[float] | None, before: str) -> str:
    if x is None:
        return ""
    numbers = ", ".join(f"{v:.4g}" for v in x[:4])
    return f"{before}{numbers}{', ...' if len(x) > 4 else ''}"
