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

#: How the command line made the campaign: where its simulator is.
DECLARED = "command.json"


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
    found = load_object(_located(declared["simulator"], declared["folder"]))
    if not callable(found):
        raise ValueError(
            f"expected a function or SimulatorModel; got {type(found).__name__} under "
            f"{declared['simulator']}; name what takes (theta, action)"
        )
    return found


def effects_of(declared: Mapping[str, Any]) -> list[Any]:
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


def open_campaign(arguments: argparse.Namespace, *, simulates: bool) -> Campaign:
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
    simulator = with_noise(simulator_of(declared), declared["noise"])
    effects = effects_of(declared)
    reader = Campaign.load(folder)
    if reader.state.version.effects:
        known = {effect.name for effect in effects}
        generic = genericeffects_of(simulator, reader.actions, prior=reader.prior)
        effects += [e for e in generic if e.name not in known]
    return Campaign.load(folder, simulator=simulator, effects=effects)


def library_of(campaign: Campaign, arguments: argparse.Namespace) -> list[Any]:
    """Return the effects to compare: the campaign's, and those that are usual."""
    own = [*campaign.effects]
    taken = {effect.name for effect in own}
    # An adopted effect is declared for the simulator without it.
    base = getattr(campaign.simulator, "base", campaign.simulator)
    generic = genericeffects_of(base, campaign.actions, prior=campaign.first_prior)
    return [*own, *(e for e in generic if e.name not in taken)]
