"""``sbi-active init``, ``ask``, ``tell`` and the other commands on a campaign's folder.

What needs no simulation needs no simulator: ``tell``, ``status``, ``correct`` and
``withdraw`` work where the simulator is not installed.
"""

from __future__ import annotations

import argparse
import csv
import io
import math
import re
import sys
from pathlib import Path
from typing import Any

import torch

from sbi_active.campaign import Campaign, CampaignOptions
from sbi_active.cli.check import actions_of, number_of, numbers_of, prior_of
from sbi_active.cli.declared import (
    declared_by,
    read_declared,
    write_declared,
)
from sbi_active.cli.folder import (
    effects_of,
    library_of,
    open_campaign,
    read_config,
    simulator_of,
)
from sbi_active.cli.trials import asked, confirm, places, print_status, written


def init(arguments: argparse.Namespace) -> int:
    """Make a campaign in a new folder."""
    if arguments.config is not None:
        read_config(arguments)
    declared = declared_by(arguments)
    options = {
        name: value
        for name in ("num_simulations", "num_workers", "num_samples", "time_limit")
        if (value := getattr(arguments, name)) is not None
    }
    with Campaign(
        simulator_of(arguments.simulator, arguments.noise),
        prior_of(arguments),
        _labeled(actions_of(arguments), arguments),
        method=arguments.method,
        effects=effects_of(declared["effects"]),
        seed=arguments.seed,
        options=CampaignOptions(**options),
        directory=arguments.folder,
    ) as campaign:
        folder = Path(arguments.folder)
        write_declared(folder, declared)
        print(f"{folder}: a campaign of {campaign.actions}")
    print(f"next: sbi-active ask {arguments.folder}")
    return 0


def ask(arguments: argparse.Namespace) -> int:
    """Print the action of the next trial."""
    with open_campaign(arguments, simulates=True) as campaign:
        trial = campaign.ask(target=arguments.target)
        answer = asked(campaign, trial)
    if arguments.json:
        arguments.answer = answer
        return 0
    print(f"trial {trial.index}: {written(campaign, trial)}")
    gain = answer["expected_information_gain"]
    if gain is not None:
        print(f"it is expected to tell {gain:.2f} nats about {trial.target}")
    print(f"then: sbi-active tell {arguments.folder} {places(campaign)}")
    return 0


def tell(arguments: argparse.Namespace) -> int:
    """Record what a trial gave; it is on the disk when this ends."""
    with open_campaign(arguments, simulates=False) as campaign:
        number, action = arguments.trial, _action(arguments)
        if number is not None:
            _require_trial(campaign, number)
        status = _status(arguments)
        x = None if status != "ok" else _outcome(arguments, campaign)
        try:
            told = campaign.tell(x, trial=number, action=action, status=status)
        except ValueError as error:
            if not str(error).startswith("expected a pending trial"):
                raise
            raise ValueError(
                "expected a pending trial; got none; ask for one by sbi-active ask "
                f"{arguments.folder}, add --action of the trial that was run, or "
                f"sbi-active correct {arguments.folder} TRIAL where one is wrong"
            ) from None
        return confirm(arguments, campaign, told)


def correct(arguments: argparse.Namespace) -> int:
    """Replace what was told of a trial."""
    with open_campaign(arguments, simulates=False) as campaign:
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
        return confirm(arguments, campaign, told)


def withdraw(arguments: argparse.Namespace) -> int:
    """Take a trial out."""
    with open_campaign(arguments, simulates=False) as campaign:
        _require_trial(campaign, arguments.trial)
        told = campaign.withdraw(arguments.trial, reason=arguments.reason)
        return confirm(arguments, campaign, told)


def update(arguments: argparse.Namespace) -> int:
    """Bring the belief up to date with the trials told so far."""
    with open_campaign(arguments, simulates=True) as campaign:
        campaign.update()
        return print_status(arguments, campaign)


def status(arguments: argparse.Namespace) -> int:
    """Print the trials, the belief and the health."""
    return print_status(arguments, open_campaign(arguments, simulates=False))


def criticize(arguments: argparse.Namespace) -> int:
    """Compare the campaign's simulator with its trials, and print the report."""
    with open_campaign(arguments, simulates=True) as campaign:
        own = [] if arguments.effects is None else effects_of([arguments.effects])
        report = campaign.criticize(library_of(campaign, own))
    print(report)
    if arguments.out is not None:
        print(f"\nsaved: {report.save(arguments.out)}")
    if report.tracing.chosen:
        named = "" if arguments.effects is None else f" --effects {arguments.effects}"
        print(f"\nto go on with it: sbi-active adopt {arguments.folder}{named}")
    return 0


def adopt(arguments: argparse.Namespace) -> int:
    """Go on with the simulator that the verdict names."""
    with open_campaign(arguments, simulates=True) as campaign:
        own = [] if arguments.effects is None else effects_of([arguments.effects])
        report = campaign.criticize(library_of(campaign, own), evaluate=False)
        campaign.adopt(report)
        if arguments.effects is not None:
            _declare_effects(Path(arguments.folder), arguments.effects)
        print(f"adopted: {report.verdict}", file=sys.stderr)
        return print_status(arguments, campaign)


def repair(arguments: argparse.Namespace) -> int:
    """Give up what is damaged, and name what has to be told again."""
    with open_campaign(arguments, simulates=False, repair=True) as campaign:
        return print_status(arguments, campaign)


def report(arguments: argparse.Namespace) -> int:
    """Write one page that shows the campaign."""
    from sbi_active.campaign.display.page import write_page

    campaign = open_campaign(arguments, simulates=False)
    path = arguments.out or Path(arguments.folder) / "report.html"
    return _saved(arguments, write_page(campaign, Path(path)))


def export(arguments: argparse.Namespace) -> int:
    """Write the belief and the trials as ArviZ reads them."""
    from sbi_active.export import to_inference_data

    simulates = arguments.trust or arguments.simulator is not None
    campaign = open_campaign(arguments, simulates=simulates)
    if not simulates:
        print(
            "sbi-active: note: without predictions and likelihoods, for which the "
            "simulator runs: add --simulator, or --trust",
            file=sys.stderr,
        )
    data = to_inference_data(campaign, seed=arguments.seed)
    try:
        data.to_netcdf(str(arguments.netcdf))
    except (ImportError, ValueError) as error:
        raise ValueError(
            f"expected a library that writes netCDF; got none ({error}); install one: "
            "pip install h5netcdf"
        ) from error
    return _saved(arguments, arguments.netcdf)


def _saved(arguments: argparse.Namespace, path: object) -> int:
    if arguments.json:
        arguments.answer = {"saved": str(path)}
    else:
        print(f"saved: {path}")
    return 0


def _declare_effects(folder: Path, name: str) -> None:
    """Let the commands to come find effects that the campaign was made without."""
    declared = read_declared(folder)
    module, colon, attribute = name.partition(":")
    if module.endswith(".py"):
        name = f"{Path(module).resolve()}{colon}{attribute}"
    effects = [*(declared.get("effects") or ()), name]
    write_declared(folder, {**declared, "effects": [*dict.fromkeys(effects)]})


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
    return None if arguments.action is None else numbers_of(arguments.action)


def _status(arguments: argparse.Namespace) -> Any:
    flags = [name for name in ("invalid", "missing") if getattr(arguments, name)]
    if len(flags) + bool(arguments.x) + (arguments.file is not None) > 1:
        raise ValueError(
            "expected numbers, --file, --invalid or --missing; got several; write one"
        )
    return flags[0] if flags else "ok"


def _outcome(arguments: argparse.Namespace, campaign: Campaign) -> Any:
    """Return what was measured, in the shape of the simulator's x."""
    if arguments.file is not None:
        numbers = _numbers_in(arguments.file)
    else:
        numbers = [number_of(cell, is_outcome=True) for cell in arguments.x]
        is_correction = getattr(arguments, "reason", None) is not None
        if not numbers and is_correction and arguments.action is not None:
            return None  # of the action alone
    shape = campaign.x_shape
    if len(numbers) != shape.numel():
        raise ValueError(
            f"expected {shape.numel()} numbers, as the simulator gives; got "
            f"{len(numbers)}; write nan for one that was not measured, --invalid where "
            "the trial gave none, or --missing where it failed"
        )
    if all(map(math.isnan, numbers)):
        raise ValueError(
            "expected a number that was measured; got none; write --invalid where the "
            "trial ran and gave none, which tells about the parameters, or --missing "
            "where it failed"
        )
    return torch.tensor(numbers, dtype=torch.float64).reshape(shape)


def _numbers_in(path: Path) -> list[float]:
    """Return the numbers of a file; an empty cell of a row was not measured."""
    try:
        text = path.read_text(encoding="utf-8-sig")
        rows = [*csv.reader(io.StringIO(text, newline=""), strict=True)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(
            f"expected a table of numbers, as text in UTF-8; got {path} ({error}); "
            "save it so"
        ) from error
    # A heading has no cell that begins like a number: 0.84 m and 0,84;1 are none.
    begins = re.compile(r"\s*(?:[-+]?\.?\d|[-+]?(?:nan|inf)\b|$)", re.IGNORECASE)
    is_headed = bool(rows) and not any(map(begins.match, rows[0]))
    return [
        number_of(
            cell.strip() or "nan", f" in row {i}, column {k} of {path}", is_outcome=True
        )
        for i, row in enumerate(rows, start=1)
        if i > 1 or not is_headed
        for k, cell in enumerate(row, start=1)
    ]


def _require_trial(campaign: Campaign, number: int) -> None:
    count = len(campaign.state.trials)
    if not 0 <= number < count:
        raise ValueError(
            f"expected a trial from 0 to {count - 1}; got {number}; see sbi-active "
            "status"
        )
