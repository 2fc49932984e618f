"""What a campaign and its trials are as JSON, and as lines for people."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any

from sbi_active.cli.output import Answer
from sbi_active.cli.record import sum_up


def sum_up_campaign(campaign: Any) -> None:
    """Leave a summary in the folder of a campaign that holds the right to write."""
    actions = campaign.actions
    with contextlib.suppress(Exception):  # a belief without moments has no summary
        is_box = type(actions).__name__ == "BoxActions"
        limits = [actions.low.tolist(), actions.high.tolist()] if is_box else [[], []]
        known = {
            "status": summary_of(campaign),
            "x_shape": [*campaign.x_shape],
            "labels": {"names": [*actions.names], "units": [*actions.units]},
            "limits": [*zip(*limits, strict=True)],
            "processed": [*campaign.state.processed],
        }
        sum_up(campaign.directory, known)


def summary_of(campaign: Any) -> dict[str, Any]:
    """Return the trials, the belief and the health of a campaign as JSON."""
    belief = campaign.belief
    mean, variance = belief.mean.reshape(-1), belief.variance.reshape(-1)
    names = campaign.parameter_names or [f"theta_{k + 1}" for k in range(len(mean))]
    diagnostics = getattr(belief, "diagnostics", None)
    said = [] if diagnostics is None else [*diagnostics.warnings]
    together = getattr(diagnostics, "combinations", None)
    return {
        "method": campaign.state.method,
        "trials": [trial_of(campaign, trial) for trial in campaign.state.trials],
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
        "not_in_belief": [
            t.index for t in campaign.history if not campaign.contains(t)
        ],
    }


def trial_of(campaign: Any, trial: Any) -> dict[str, Any]:
    """Return a trial as JSON, but for NaN."""
    if isinstance(trial, dict):
        return trial
    return {
        "trial": trial.index,
        "status": trial.status,
        "action": trial.action.tolist(),
        "names": [*campaign.actions.names],
        "units": [*campaign.actions.units],
        "x": None if trial.x is None else trial.x.flatten().tolist(),
        "information_gained": trial.information_gained,
        "surprise": trial.surprise,
        "target": trial.target,
        "reason": trial.reason,
    }


def answer_of(campaign: Any) -> Answer:
    """Return the trials, the belief and the health of a campaign or a record."""
    data = getattr(campaign, "status", None) or summary_of(campaign)
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
        shown = f"{place_of(trial)}{numbers_of(trial, '  x = ')}{gain}{why}"
        lines.append(f"{trial['trial']:>4}  {trial['status']:<9} {shown}")
    for name, entry in belief["parameters"].items():
        lines.append(f"{name:>12} = {entry['mean']:.4g} +- {entry['sd']:.2g}")
    lines += [f"note: {w}" for w in belief["warnings"]]
    if waiting := data["not_in_belief"]:
        lines.append(f"not in the belief yet: {waiting}; run sbi-active update")
    return Answer(data, "\n".join(lines))


def place_of(trial: Mapping[str, Any]) -> str:
    """Return a trial's action with names and units."""
    parts = zip(trial["names"], trial["action"], trial["units"], strict=True)
    return ", ".join(f"{n} = {v:.6g}{f' {u}' if u else ''}" for n, v, u in parts)


def numbers_of(trial: Mapping[str, Any], before: str) -> str:
    """Return the first numbers of a trial's outcome, nothing where there is none."""
    x: Sequence[float] | None = trial["x"]
    if x is None:
        return ""
    return f"{before}{', '.join(f'{v:.4g}' for v in x[:4])}{', ...' * (len(x) > 4)}"
