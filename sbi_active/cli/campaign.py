"""``sbi-active init``, ``ask``, ``tell`` and the other commands on a campaign's folder.

What needs no simulation needs no simulator: ``tell``, ``status``, ``correct`` and
``withdraw`` work where the simulator is not installed.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import sys
from pathlib import Path
from typing import Any

from sbi_active.campaign import Campaign, CampaignOptions
from sbi_active.cli.check import actions_of, prior_of
from sbi_active.cli.folder import (
    DECLARED,
    declared_by,
    effects_of,
    library_of,
    named_effects,
    open_campaign,
    read_config,
    simulator_of,
)
from sbi_active.cli.trials import asked, confirm, places, print_status, written
from sbi_active.cli.words import answer
from sbi_active.simulation.bank.segments import write_file

#: Options of ``criticize`` that say of a table what a campaign knows.
OF_TABLES = (
    *("config", "columns", "units", "inputs", "task", "prior", "theta_low"),
    *("theta_high", "noise", "actions"),
)
LARGEST = 3.4028234e38  # that single precision holds


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
        simulator_of(declared),
        prior_of(arguments),
        _labeled(actions_of(arguments), arguments),
        method=arguments.method,
        effects=effects_of(declared),
        seed=arguments.seed,
        options=CampaignOptions(**options),
        directory=arguments.folder,
    ) as campaign:
        folder = Path(arguments.folder)
        write_file(folder / DECLARED, (json.dumps(declared, indent=2) + "\n").encode())
        print(f"{folder}: a campaign of {campaign.actions}")
    print(f"next: sbi-active ask {arguments.folder}")
    return 0


def ask(arguments: argparse.Namespace) -> int:
    """Print the action of the next trial."""
    with open_campaign(arguments, simulates=True) as campaign:
        trial = campaign.ask(target=arguments.target)
        known = asked(campaign, trial)
    if arguments.json:
        answer(known)
        return 0
    print(f"trial {trial.index}: {written(campaign, trial)}")
    gain = known["expected_information_gain"]
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
    given = [n for n in OF_TABLES if getattr(arguments, n, None) is not None]
    if given:
        raise ValueError(
            f"expected no --{given[0].replace('_', '-')} with a campaign's folder, "
            f"which knows its own; got {getattr(arguments, given[0])}; leave it out"
        )
    own = named_effects(arguments)
    with open_campaign(arguments, simulates=True) as campaign:
        usual, taken = library_of(campaign), {effect.name for effect in own}
        report = campaign.criticize([*own, *(e for e in usual if e.name not in taken)])
    print(report)
    if arguments.out is not None:
        print(f"\nsaved: {report.save(arguments.out)}")
    if report.tracing.chosen:
        print(f"\nto go on with it: sbi-active adopt {arguments.folder}")
    return 0


def adopt(arguments: argparse.Namespace) -> int:
    """Go on with the simulator that the verdict names."""
    with open_campaign(arguments, simulates=True) as campaign:
        report = campaign.criticize(library_of(campaign), evaluate=False)
        campaign.adopt(report)
        print(f"adopted: {report.verdict}", file=sys.stderr)
        return print_status(arguments, campaign)


def repair(arguments: argparse.Namespace) -> int:
    """Give up what is damaged, and name what has to be told again."""
    with Campaign.load(arguments.folder, repair=True) as campaign:
        return print_status(arguments, campaign)


def report(arguments: argparse.Namespace) -> int:
    """Write one page that shows the campaign."""
    from sbi_active.campaign.display.page import write_page

    campaign = open_campaign(arguments, simulates=False)
    path = arguments.out or Path(arguments.folder) / "report.html"
    print(f"saved: {write_page(campaign, Path(path))}")
    return 0


def export(arguments: argparse.Namespace) -> int:
    """Write the belief and the trials as ArviZ reads them."""
    from sbi_active.export import to_inference_data

    campaign = open_campaign(arguments, simulates=True)
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
        numbers = _read_numbers(arguments.file)
    else:
        if any(not cell.strip() for cell in arguments.x):
            raise ValueError(
                "expected numbers; got an empty one; write what was measured, nan for "
                "one of several that was not, or --invalid"
            )
        numbers = _numbers(arguments.x)
    shape = campaign.x_shape
    if not numbers and arguments.action is not None and "reason" in arguments:
        return None  # a correction of the action alone
    if len(numbers) != shape.numel():
        raise ValueError(
            f"expected {shape.numel()} numbers, as the simulator gives; got "
            f"{len(numbers)}; write nan for one that was not measured, --invalid where "
            "the trial gave none, or --missing where it failed"
        )
    if all(math.isnan(number) for number in numbers):
        raise ValueError(
            "expected a number that was measured; got none; write --invalid where the "
            "trial ran and gave none, or --missing where a fault hit it"
        )
    large = [n for n in numbers if abs(n) > LARGEST]
    if large:
        raise ValueError(
            f"expected finite numbers that single precision holds; got {large[0]:g}; "
            "correct it, or write nan where the sensor gave none"
        )
    import torch

    return torch.tensor(numbers).reshape(shape)


def _read_numbers(path: Path) -> list[float]:
    """Return the numbers of a file, whose first row may be a header."""
    with open(path, newline="", encoding="utf-8-sig") as file:
        rows = [[cell.strip() for cell in row] for row in csv.reader(file) if row]
    if len(rows) > 1 and not _are_numbers(rows[0]):
        rows = rows[1:]
    cells = [cell for row in rows for cell in row]
    if not any(cells):
        raise ValueError(
            f"expected numbers in {path}; got none; write one a line, or separate them "
            "by commas"
        )
    wrong = [cell for cell in cells if not _are_numbers([cell])]
    if wrong:
        raise ValueError(
            f"expected numbers in {path}; got {wrong[0]!r:.80}; separate them by "
            "commas, and leave out units"
        )
    return _numbers(cells)


def _are_numbers(cells: list[str]) -> bool:
    try:
        _numbers(cells)
    except ValueError:
        return False
    return True


def _numbers(cells: list[str]) -> list[float]:
    try:
        return [float(cell) if cell.strip() else math.nan for cell in cells]
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
