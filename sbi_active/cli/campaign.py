"""``sbi-active init``, ``ask``, ``tell`` and the other commands on a campaign's folder.

What needs no simulation needs no simulator: ``tell``, ``status``, ``correct`` and
``withdraw`` work where the simulator is not installed.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from sbi_active.campaign import Campaign, CampaignOptions, Trial
from sbi_active.cli.check import actions_of, prior_of, with_noise
from sbi_active.cli.loading import load_object
from sbi_active.criticism import generic_effects

#: How the command line made the campaign: where its simulator is.
DECLARED = "command.json"


def init(arguments: argparse.Namespace) -> int:
    """Make a campaign in a new folder."""
    declared = _declared(arguments)
    options = {
        name: value
        for name in ("num_simulations", "num_workers", "num_samples", "time_limit")
        if (value := getattr(arguments, name)) is not None
    }
    with Campaign(
        with_noise(_simulator(declared), declared["noise"]),
        prior_of(arguments),
        _labeled(actions_of(arguments), arguments),
        method=arguments.method,
        effects=_effects(declared),
        seed=arguments.seed,
        options=CampaignOptions(**options),
        directory=arguments.folder,
    ) as campaign:
        folder = Path(arguments.folder)
        (folder / DECLARED).write_text(json.dumps(declared, indent=2) + "\n")
        print(f"{folder}: a campaign of {campaign.actions}")
    print(f"next: sbi-active ask {arguments.folder}")
    return 0


def ask(arguments: argparse.Namespace) -> int:
    """Print the action of the next trial."""
    with _computing(arguments) as campaign:
        trial = campaign.ask(target=arguments.target)
        answer = _asked(campaign, trial)
    if arguments.json:
        print(json.dumps(answer))
        return 0
    print(f"trial {trial.index}: {_written(campaign, trial)}")
    gain = answer["expected_information_gain"]
    if gain is not None:
        print(f"it is expected to tell {gain:.2f} nats about {trial.target}")
    print(f"then: sbi-active tell {arguments.folder} {_places(campaign)}")
    return 0


def tell(arguments: argparse.Namespace) -> int:
    """Record what a trial gave; it is on the disk when this ends."""
    with Campaign.load(arguments.folder) as campaign:
        number, action = arguments.trial, _action(arguments)
        pending = campaign.pending
        if number is None and pending is None and action is None:
            raise ValueError(
                "expected a pending trial; got none; ask for one by sbi-active ask "
                f"{arguments.folder}, or add --action of the trial that was run"
            )
        if number is not None:
            _require_trial(campaign, number)
        status = _status(arguments)
        x = None if status != "ok" else _outcome(arguments, campaign)
        told = campaign.tell(x, trial=number, action=action, status=status)
        return _confirm(arguments, campaign, told)


def correct(arguments: argparse.Namespace) -> int:
    """Replace what was told of a trial."""
    with Campaign.load(arguments.folder) as campaign:
        _require_trial(campaign, arguments.trial)
        status = _status(arguments)
        x = None if status != "ok" else _outcome(arguments, campaign)
        told = campaign.correct(
            arguments.trial,
            x,
            action=_action(arguments),
            status=status,
            reason=arguments.reason,
        )
        return _confirm(arguments, campaign, told)


def withdraw(arguments: argparse.Namespace) -> int:
    """Take a trial out."""
    with Campaign.load(arguments.folder) as campaign:
        _require_trial(campaign, arguments.trial)
        told = campaign.withdraw(arguments.trial, reason=arguments.reason)
        return _confirm(arguments, campaign, told)


def update(arguments: argparse.Namespace) -> int:
    """Bring the belief up to date with the trials told so far."""
    with _computing(arguments) as campaign:
        campaign.update()
        return _print_status(arguments, campaign)


def status(arguments: argparse.Namespace) -> int:
    """Print the trials, the belief and the health."""
    return _print_status(arguments, Campaign.load(arguments.folder))


def criticize(arguments: argparse.Namespace) -> int:
    """Compare the campaign's simulator with its trials, and print the report."""
    with _computing(arguments) as campaign:
        report = campaign.criticize(_library(campaign, arguments))
    print(report)
    if arguments.out is not None:
        print(f"\nsaved: {report.save(arguments.out)}")
    if report.tracing.chosen:
        print(f"\nto go on with it: sbi-active adopt {arguments.folder}")
    return 0


def adopt(arguments: argparse.Namespace) -> int:
    """Go on with the simulator that the verdict names."""
    with _computing(arguments) as campaign:
        report = campaign.criticize(_library(campaign, arguments), evaluate=False)
        campaign.adopt(report)
        print(f"adopted: {report.verdict}", file=sys.stderr)
        return _print_status(arguments, campaign)


def report(arguments: argparse.Namespace) -> int:
    """Write one page that shows the campaign."""
    from sbi_active.campaign.display.page import write_page

    campaign = _campaign(arguments, simulates=False)
    path = arguments.out or Path(arguments.folder) / "report.html"
    print(f"saved: {write_page(campaign, Path(path))}")
    return 0


def export(arguments: argparse.Namespace) -> int:
    """Write the belief and the trials as ArviZ reads them."""
    from sbi_active.export import to_inference_data

    campaign = _campaign(arguments, simulates=True)
    data = to_inference_data(campaign, seed=arguments.seed)
    try:
        data.to_netcdf(str(arguments.netcdf))
    except (ImportError, ValueError) as error:
        raise ValueError(
            f"expected a library that writes netCDF; got none ({error}); install one: "
            "pip install h5netcdf"
        ) from error
    print(f"saved: {arguments.netcdf}")
    return 0


def _declared(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return where the simulator and the effects are, as the other commands need it."""
    if arguments.simulator is None:
        raise ValueError(
            "expected --simulator; got none; name it, as in --simulator my_robot.py:fn"
        )
    return {
        "simulator": arguments.simulator,
        "effects": arguments.effects,
        "noise": arguments.noise,
        "folder": os.getcwd(),
    }


def _simulator(declared: Mapping[str, Any]) -> Any:
    found = load_object(_located(declared["simulator"], declared["folder"]))
    if not callable(found):
        raise ValueError(
            f"expected a function or SimulatorModel; got {type(found).__name__} under "
            f"{declared['simulator']}; name what takes (theta, action)"
        )
    return found


def _effects(declared: Mapping[str, Any]) -> list[Any]:
    if declared["effects"] is None:
        return []
    found = load_object(_located(declared["effects"], declared["folder"]))
    return [*(found() if callable(found) else found)]


def _located(name: str, folder: str) -> str:
    """Return MODULE:NAME with a file's path from where the campaign was made."""
    module, separator, attribute = name.partition(":")
    if not module.endswith(".py"):
        sys.path.insert(0, folder)
        return name
    return f"{Path(folder, module)}{separator}{attribute}"


def _campaign(arguments: argparse.Namespace, *, simulates: bool) -> Campaign:
    """Return the campaign of a folder, with its simulator where that is asked for."""
    folder = Path(arguments.folder)
    if not simulates:
        return Campaign.load(folder)
    Campaign.load(folder)  # a folder without a campaign is an error here
    declared = {"simulator": None, "effects": None, "noise": None, "folder": "."}
    if (folder / DECLARED).exists():
        declared = json.loads((folder / DECLARED).read_text())
    if getattr(arguments, "simulator", None) is not None:
        declared |= {"simulator": arguments.simulator, "folder": os.getcwd()}
    if declared["simulator"] is None:
        raise ValueError(
            f"expected --simulator, since the campaign in {folder} was made by a "
            "program; got none; name it, as in --simulator my_robot.py:fn"
        )
    simulator = with_noise(_simulator(declared), declared["noise"])
    effects = _effects(declared)
    reader = Campaign.load(folder)
    if reader.state.version.effects:
        known = {effect.name for effect in effects}
        generic = generic_effects(simulator, reader.actions, prior=reader.prior)
        effects += [e for e in generic if e.name not in known]
    return Campaign.load(folder, simulator=simulator, effects=effects)


def _computing(arguments: argparse.Namespace) -> Campaign:
    return _campaign(arguments, simulates=True)


def _library(campaign: Campaign, arguments: argparse.Namespace) -> list[Any]:
    """Return the effects to compare: the campaign's, and those that are usual."""
    own = [*campaign.effects]
    taken = {effect.name for effect in own}
    # An adopted effect is declared for the simulator without it.
    base = getattr(campaign.simulator, "base", campaign.simulator)
    generic = generic_effects(base, campaign.actions, prior=campaign.first_prior)
    return [*own, *(e for e in generic if e.name not in taken)]


def _labeled(actions: Any, arguments: argparse.Namespace) -> Any:
    """Return the actions with --names and --units."""
    for what in ("names", "units"):
        text = getattr(arguments, what)
        if text is None:
            continue
        labels = text.split(",")
        if len(labels) != actions.action_dim:
            raise ValueError(
                f"expected --{what} of {actions.action_dim} entries; got {text!r}; "
                "separate them by commas, one an entry of the action"
            )
        setattr(actions, what, labels)
    return actions


def _action(arguments: argparse.Namespace) -> list[float] | None:
    return None if arguments.action is None else _numbers(arguments.action.split(","))


def _status(arguments: argparse.Namespace) -> Any:
    given = [*arguments.x, *([arguments.file] if arguments.file else [])]
    flags = [name for name in ("invalid", "missing") if getattr(arguments, name)]
    if len(flags) + bool(given) > 1:
        raise ValueError(
            "expected numbers, --file, --invalid or --missing; got several; write one"
        )
    return flags[0] if flags else "ok"


def _outcome(arguments: argparse.Namespace, campaign: Campaign) -> Any:
    """Return what was measured, in the shape of the simulator's x."""
    if arguments.file is not None:
        with open(arguments.file, newline="") as file:
            cells = [cell.strip() for row in csv.reader(file) for cell in row]
        try:
            _numbers(cells[:1])
        except ValueError:  # a header
            with open(arguments.file, newline="") as file:
                cells = [c.strip() for row in [*csv.reader(file)][1:] for c in row]
        numbers = _numbers(cells)
    else:
        numbers = _numbers(arguments.x)
    shape = campaign.x_shape
    if not numbers and getattr(arguments, "reason", None) is not None:
        return None  # a correction of the action alone
    if len(numbers) != shape.numel():
        raise ValueError(
            f"expected {shape.numel()} numbers, as the simulator gives; got "
            f"{len(numbers)}; write nan for one that was not measured, --invalid where "
            "the trial gave none, or --missing where it failed"
        )
    import torch

    return torch.tensor(numbers).reshape(shape)


def _numbers(cells: list[str]) -> list[float]:
    try:
        return [float(cell) if cell else math.nan for cell in cells]
    except ValueError:
        raise ValueError(
            f"expected numbers; got {' '.join(cells)!r:.80}; write them with a point, "
            "as in 1.5 or 2e-3"
        ) from None


def _require_trial(campaign: Campaign, number: int) -> None:
    count = len(campaign.state.trials)
    if not 0 <= number < count:
        raise ValueError(
            f"expected a trial from 0 to {count - 1}; got {number}; see sbi-active "
            "status"
        )


def _confirm(arguments: argparse.Namespace, campaign: Campaign, trial: Trial) -> int:
    if arguments.json:
        print(json.dumps(_described(campaign, trial)))
        return 0
    x = "" if trial.x is None else f", x = {_short(trial.x)}"
    print(f"trial {trial.index}: {trial.status} at {_written(campaign, trial)}{x}")
    print(f"next: sbi-active ask {arguments.folder}")
    return 0


def _print_status(arguments: argparse.Namespace, campaign: Campaign) -> int:
    told = [_described(campaign, trial) for trial in campaign.state.trials]
    waiting = [t.index for t in campaign.history if not campaign.contains(t)]
    belief = _believed(campaign)
    if arguments.json:
        answer = {"trials": told, "belief": belief, "health": campaign.health}
        print(json.dumps({**answer, "not_in_belief": waiting}))
        return 0
    print(f"{campaign!r}, health {campaign.health}")
    for trial in campaign.state.trials:
        x = "" if trial.x is None else f"  x = {_short(trial.x)}"
        gained = trial.information_gained
        gain = "" if gained is None else f"  {gained:.2f} nats"
        reason = f"  ({trial.reason})" if trial.reason else ""
        place = _written(campaign, trial)
        print(f"{trial.index:>4}  {trial.status:<9} {place}{x}{gain}{reason}")
    for name, entry in belief["parameters"].items():
        print(f"{name:>12} = {entry['mean']:.4g} +- {entry['sd']:.2g}")
    for text in belief["warnings"]:
        print(f"note: {text}")
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


def _asked(campaign: Campaign, trial: Trial) -> dict[str, Any]:
    gain, error = None, None
    if trial.design is not None:
        gains = trial.design.expected_information_gain[trial.design.index]
        errors = trial.design.standard_error[trial.design.index]
        gain, error = _finite(gains), _finite(errors)
    return {
        **_described(campaign, trial),
        "target": trial.target,
        "expected_information_gain": gain,
        "standard_error": error,
    }


def _described(campaign: Campaign, trial: Trial) -> dict[str, Any]:
    """Return a trial as JSON: NaN is null."""
    x = None if trial.x is None else [_finite(v) for v in trial.x.flatten()]
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


def _finite(value: Tensor) -> float | None:
    number = float(value)
    return number if math.isfinite(number) else None


def _written(campaign: Campaign, trial: Trial) -> str:
    parts = zip(
        campaign.actions.names,
        trial.action.tolist(),
        campaign.actions.units,
        strict=True,
    )
    return ", ".join(f"{n} = {v:.6g}{f' {u}' if u else ''}" for n, v, u in parts)


def _places(campaign: Campaign) -> str:
    count = campaign.x_shape.numel()
    return "X" if count == 1 else "--file X.csv" if count > 5 else "X " * (count - 1) + "X"


def _short(x: Tensor) -> str:
    numbers = [f"{v:.4g}" for v in x.flatten()[:4].tolist()]
    return ", ".join(numbers) + (", ..." if x.numel() > 4 else "")
