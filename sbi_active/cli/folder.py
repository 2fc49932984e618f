"""A campaign's folder and the simulator that the command line declared for it."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sbi_active.campaign import Campaign
from sbi_active.cli.check import with_noise
from sbi_active.cli.loading import load_object
from sbi_active.criticism import Effect, generic_effects
from sbi_active.simulation import SimulatorModel

#: How the command line made the campaign: where its simulator is.
DECLARED = "command.json"
#: Of ``init``, which a file may change.
DEFAULTS = {"method": "asbi", "seed": 0}


def read_config(arguments: argparse.Namespace) -> None:
    """Take options from --config that the command line leaves out.

    Args:
        arguments: Changed in place.

    Raises:
        ValueError: If the file has no such options.
    """
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib

    try:
        values = tomllib.loads(arguments.config.read_text())
    except tomllib.TOMLDecodeError as error:
        raise ValueError(
            f"expected TOML in {arguments.config}; got {error}; write options as in "
            'theta-low = "0,1"'
        ) from error
    known = vars(arguments).keys() - {"folder", "config", "command"}
    for name, value in values.items():
        key = name.replace("-", "_")
        if key not in known:
            raise ValueError(
                f"expected options among {', '.join(sorted(known))}; got {name!r} in "
                f"{arguments.config}; remove it or write one of these"
            )
        given = getattr(arguments, key)
        if given is None or (key, given) in DEFAULTS.items():
            setattr(arguments, key, _as_written(key, value))


def _as_written(key: str, value: Any) -> Any:
    """Return a value of TOML as the command line writes it."""
    if key == "actions":
        return [str(part) for part in (value if isinstance(value, list) else [value])]
    if isinstance(value, list):
        return ",".join(map(str, value))
    numbers = ("theta_low", "theta_high", "noise", "names", "units")
    return str(value) if key in numbers else value


def declared_by(arguments: argparse.Namespace) -> dict[str, Any]:
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


def simulator_of(declared: Mapping[str, Any]) -> Any:
    """Return the simulator that was declared, without the noise of --noise.

    Raises:
        ValueError: If it is not there, or no function.
    """
    found = load_object(_located(declared["simulator"], declared["folder"]))
    if not callable(found):
        raise ValueError(
            f"expected a function or SimulatorModel; got {type(found).__name__} under "
            f"{declared['simulator']}; name what takes (theta, action)"
        )
    return found


def effects_of(declared: Mapping[str, Any]) -> list[Effect]:
    """Return the effects that were declared."""
    if declared["effects"] is None:
        return []
    found: Any = load_object(_located(declared["effects"], declared["folder"]))
    listed: Any = found() if callable(found) else found
    return [*listed]


def _located(name: str, folder: str) -> str:
    """Return MODULE:NAME with a file's path from where the campaign was made."""
    module, separator, attribute = name.partition(":")
    if not module.endswith(".py"):
        sys.path.insert(0, folder)
        return name
    return f"{Path(folder, module)}{separator}{attribute}"


def open_campaign(arguments: argparse.Namespace, *, simulates: bool) -> Campaign:
    """Return the campaign of a folder, with its simulator where that is asked for."""
    folder = Path(arguments.folder)
    if not simulates:
        return Campaign.load(folder)
    reader = Campaign.load(folder)  # a folder without a campaign is an error here
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
    simulator = with_noise(simulator_of(declared), declared["noise"])
    effects = effects_of(declared)
    if reader.state.version.effects:
        effects = _with_usual(effects, simulator, reader)
    return Campaign.load(folder, simulator=simulator, effects=effects)


def library_of(campaign: Campaign, folder: Path) -> list[Effect]:
    """Return the effects to compare: the campaign's own, and those that are usual."""
    # An adopted effect is declared for the simulator without it.
    base = getattr(campaign.simulator, "base", campaign.simulator)
    return _with_usual([*campaign.effects], base, Campaign.load(folder))


def _with_usual(own: list[Effect], simulator: Any, reader: Campaign) -> list[Effect]:
    """Return effects and the generic ones of other names.

    Args:
        own: Declared ones.
        simulator: As it was before any was adopted.
        reader: The campaign, with the prior from before.
    """
    if not isinstance(simulator, SimulatorModel):
        simulator = SimulatorModel(simulator)
    taken = {effect.name for effect in own}
    generic = generic_effects(simulator, reader.actions, prior=reader.prior)
    return [*own, *(effect for effect in generic if effect.name not in taken)]
