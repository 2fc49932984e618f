"""A campaign and its trials, as text and as JSON."""

from __future__ import annotations

import argparse
from typing import Any

from torch import Tensor

from sbi_active.campaign import Campaign, Trial
from sbi_active.cli.words import spoken

MANY = 5  # numbers, more than somebody types


def confirm(arguments: argparse.Namespace, campaign: Campaign, trial: Trial) -> int:
    """Print what was recorded, and what comes next."""
    if arguments.json:
        arguments.answer = _described(campaign, trial)
        return 0
    x = "" if trial.x is None else f", x = {_short(trial.x)}"
    print(f"trial {trial.index}: {trial.status} at {written(campaign, trial)}{x}")
    print(f"next: sbi-active ask {arguments.folder}")
    return 0


def print_status(arguments: argparse.Namespace, campaign: Campaign) -> int:
    """Print the trials, the belief and the health."""
    told = [_described(campaign, trial) for trial in campaign.state.trials]
    waiting = [t.index for t in campaign.history if not campaign.contains(t)]
    belief = _believed(campaign)
    if arguments.json:
        answer = {"trials": told, "belief": belief, "health": campaign.health}
        arguments.answer = {**answer, "not_in_belief": waiting}
        return 0
    print(f"{campaign!r}, health {campaign.health}")
    for trial in campaign.state.trials:
        x = "" if trial.x is None else f"  x = {_short(trial.x)}"
        gained = trial.information_gained
        gain = "" if gained is None else f"  {gained:.2f} nats"
        reason = f"  ({trial.reason})" if trial.reason else ""
        place = written(campaign, trial)
        print(f"{trial.index:>4}  {trial.status:<9} {place}{x}{gain}{reason}")
    for name, entry in belief["parameters"].items():
        print(f"{name:>12} = {entry['mean']:.4g} +- {entry['sd']:.2g}")
    for text in belief["warnings"]:
        print(f"note: {spoken(text, arguments.folder)}")
    if waiting:
        print(f"not in the belief yet: {waiting}; run sbi-active update")
    return 0


def _believed(campaign: Campaign) -> dict[str, Any]:
    belief = campaign.belief
    mean, variance = belief.mean.reshape(-1), belief.variance.reshape(-1)
    names = campaign.parameter_names or [f"theta_{k + 1}" for k in range(len(mean))]
    diagnostics = getattr(belief, "diagnostics", None)
    return {
        "parameters": {
            name: {"mean": float(m), "sd": float(v) ** 0.5}
            for name, m, v in zip(names, mean, variance, strict=True)
        },
        "trustworthy": None if diagnostics is None else diagnostics.trustworthy,
        "warnings": [] if diagnostics is None else [*diagnostics.warnings],
    }


def asked(campaign: Campaign, trial: Trial) -> dict[str, Any]:
    """Return a designed trial as JSON."""
    gain, error = None, None
    if trial.design is not None:
        gains = trial.design.expected_information_gain[trial.design.index]
        errors = trial.design.standard_error[trial.design.index]
        gain, error = float(gains), float(errors)
    return {
        **_described(campaign, trial),
        "target": trial.target,
        "expected_information_gain": gain,
        "standard_error": error,
    }


def _described(campaign: Campaign, trial: Trial) -> dict[str, Any]:
    """Return a trial as JSON, but for NaN."""
    x = None if trial.x is None else trial.x.flatten().tolist()
    return {
        "trial": trial.index,
        "status": trial.status,
        "action": trial.action.tolist(),
        "names": [*campaign.actions.names],
        "units": [*campaign.actions.units],
        "x": x,
        "information_gained": trial.information_gained,
        "surprise": trial.surprise,
        "reason": trial.reason,
    }


def written(campaign: Campaign, trial: Trial) -> str:
    """Return a trial's action with names and units."""
    parts = zip(
        campaign.actions.names,
        trial.action.tolist(),
        campaign.actions.units,
        strict=True,
    )
    return ", ".join(f"{n} = {v:.6g}{f' {u}' if u else ''}" for n, v, u in parts)


def places(campaign: Campaign) -> str:
    """Return what stands for the numbers of an outcome on the command line."""
    count = campaign.x_shape.numel()
    return (
        "X" if count == 1 else "--file X.csv" if count > 5 else "X " * (count - 1) + "X"
    )


def _short(x: Tensor) -> str:
    numbers = [f"{v:.4g}" for v in x.flatten()[:4].tolist()]
    return ", ".join(numbers) + (", ..." if x.numel() > 4 else "")
