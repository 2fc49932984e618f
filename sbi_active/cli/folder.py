"""A campaign's folder and the simulator that the command line declared for it."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sbi_active.campaign import Campaign
from sbi_active.campaign.storage.damage import naming
from sbi_active.campaign.storage.manifest import read_manifest
from sbi_active.cli.check import with_noise
from sbi_active.cli.declared import named, read_declared, require_trust
from sbi_active.cli.loading import load_object, make_task
from sbi_active.criticism import Effect, generic_effects
from sbi_active.simulation import SimulatorModel
from sbi_active.simulation.bank.store import Store


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
        values = tomllib.loads(arguments.config.read_text(encoding="utf-8-sig"))
    except ValueError as error:
        raise ValueError(
            f"expected TOML in {arguments.config}; got {error}; write options as in "
            'theta-low = "0,1"'
        ) from error
    not_options = {"folder", "trials", "config", "command", "parser", "trust", "json"}
    known = vars(arguments).keys() - not_options
    words: list[str] = []
    for name, value in values.items():
        key = name.replace("-", "_")
        if key not in known:
            raise ValueError(
                f"expected options among {', '.join(sorted(known))}; got {name!r} in "
                f"{arguments.config}; remove it or write one of these"
            )
        words += _as_words(key, value)
    parser: argparse.ArgumentParser = arguments.parser
    written = parser.parse_args([os.devnull, *words])
    for key in {name.replace("-", "_") for name in values}:
        if getattr(arguments, key) == parser.get_default(key):
            setattr(arguments, key, getattr(written, key))


def _as_words(key: str, value: Any) -> list[str]:
    """Return an option of TOML as the command line writes it."""
    option = f"--{key.replace('_', '-')}"
    if isinstance(value, bool):
        return [option] if value else []
    if isinstance(value, dict):  # as in columns = {trial = "ball", x = "height"}
        pairs = {k: v if isinstance(v, list) else [v] for k, v in value.items()}
        return [option, *(f"{k}={','.join(map(str, v))}" for k, v in pairs.items())]
    if isinstance(value, list):
        parts = [str(part) for part in value]
        if key == "actions" or parts and all("=" in part for part in parts):
            return [option, *parts]
        return [f"{option}={','.join(parts)}"]
    return [f"{option}={value}"]


def simulator_of(name: str, noise: str | None, folder: str | None = None) -> Any:
    """Return a simulator with the noise of --noise.

    Args:
        name: As :func:`.load_object` takes it.
        noise: As written; None for the simulator's own.
        folder: As there.

    Raises:
        ValueError: If it is not there, or no function.
    """
    found = load_object(name, folder)
    if not callable(found):
        raise ValueError(
            f"expected a function or SimulatorModel; got {type(found).__name__} under "
            f"{name}; name what takes (theta, action)"
        )
    return with_noise(found, noise)


def effects_of(names: Sequence[str], folder: str | None = None) -> list[Effect]:
    """Return effects, each name that of a list or of a function that returns one.

    Args:
        names: As :func:`.load_object` takes them.
        folder: As there.

    Raises:
        ValueError: If there are none under a name.
    """
    effects: list[Effect] = []
    for name in names:
        listed: Any = load_object(name, folder)
        if callable(listed):
            listed = listed()
        try:
            found = [*listed]
        except TypeError:
            found = [listed]
        wrong = [e for e in found if not isinstance(e, Effect)]
        if wrong:
            raise ValueError(
                f"expected a list of Effect under {name}; got "
                f"{type(wrong[0]).__name__} in it; declare sbi_active.criticism.Effect"
            )
        effects += found
    return effects


def _given(
    folder: Path, declared: Mapping[str, Any], *, trusts: bool
) -> dict[str, Any]:
    """Return the prior and the actions that no file describes, from their programs."""
    with naming():
        manifest = read_manifest(Store(folder, "campaign"))
    lacking = [what for what in ("prior", "actions") if manifest[what] is None]
    if lacking and declared.get("task") is not None:
        task = _task_of(declared, folder, trusts=trusts)
        return {what: getattr(task, what) for what in lacking}
    return {
        what: load_object(name, declared.get("folder"))
        for what in lacking
        for name in named(declared, what, folder, trusts=trusts)
    }


def _task_of(declared: Mapping[str, Any], folder: Path, *, trusts: bool) -> Any:
    if declared["options"]:  # of which some name files
        text = f"options {' '.join(declared['options'])} of a task"
        require_trust(folder, text, None, trusts=trusts)
    return make_task(declared["task"], declared["options"])


def open_campaign(
    arguments: argparse.Namespace, *, simulates: bool, repair: bool = False
) -> Campaign:
    """Return the campaign of a folder.

    Args:
        arguments: With the folder.
        simulates: Whether its simulator is needed; else nothing of the folder is
            imported without --trust.
        repair: Give up what is damaged.

    Raises:
        ValueError: If there is no campaign, or nobody knows where its simulator is, or
            only the folder says so.
    """
    folder, trusts = Path(arguments.folder), arguments.trust
    declared = read_declared(folder)
    given = {}
    if simulates or trusts and declared:
        given = _given(folder, declared, trusts=trusts)
    reader = Campaign.load(folder, repair=repair, **given)
    if not simulates:
        return reader
    simulator = _simulator_of(arguments, declared, folder)
    names = named(declared, "effects", folder, trusts=trusts)
    effects = effects_of(names, declared.get("folder"))
    if reader.state.version.effects:
        effects = _with_usual(effects, simulator, reader)
    changed = getattr(arguments, "simulator_changed", False)
    return Campaign.load(
        folder, simulator=simulator, effects=effects, simulator_changed=changed, **given
    )


def _simulator_of(
    arguments: argparse.Namespace, declared: Mapping[str, Any], folder: Path
) -> Any:
    if arguments.simulator is not None:
        return simulator_of(arguments.simulator, declared.get("noise"))
    if declared.get("task") is not None:
        return _task_of(declared, folder, trusts=arguments.trust).simulator
    names = named(declared, "simulator", folder, trusts=arguments.trust)
    if not names:
        raise ValueError(
            f"expected --simulator, since the campaign in {folder} was made by a "
            "program; got none; name it, as in --simulator my_robot.py:fn"
        )
    return simulator_of(names[0], declared.get("noise"), declared.get("folder"))


def library_of(campaign: Campaign, own: Sequence[Effect] = ()) -> list[Effect]:
    """Return the effects to compare, once each.

    Args:
        campaign: Whose own follow, and then those that are usual.
        own: They come first.
    """
    taken = {effect.name for effect in own}
    known = [effect for effect in campaign.effects if effect.name not in taken]
    # An adopted effect is declared for the simulator without it.
    base = getattr(campaign.simulator, "base", campaign.simulator)
    return _with_usual([*own, *known], base, campaign)


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
    generic = generic_effects(simulator, reader.actions, prior=reader.first_prior)
    return [*own, *(effect for effect in generic if effect.name not in taken)]
