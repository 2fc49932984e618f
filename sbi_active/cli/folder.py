"""A campaign's folder and the simulator that the command line declared for it."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sbi_active.campaign import Campaign
from sbi_active.campaign.storage.manifest import read_manifest
from sbi_active.cli.check import with_noise
from sbi_active.cli.loading import load_object
from sbi_active.cli.options import make_task
from sbi_active.criticism import Effect, generic_effects
from sbi_active.simulation import SimulatorModel

#: How the command line made the campaign: where its simulator is.
DECLARED = "command.json"
#: Of ``init``, which a file may change.
DEFAULTS = {
    "method": "asbi",
    "seed": 0,
    "order": "known",
    "designed": False,
    "no_thin": False,
}


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
    known = vars(arguments).keys() - {"folder", "trials", "config", "command"}
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
    if isinstance(value, dict):  # as in columns = {trial = "ball", x = "height"}
        pairs = {k: v if isinstance(v, list) else [v] for k, v in value.items()}
        return [f"{k}={','.join(map(str, v))}" for k, v in pairs.items()]
    if key == "out":
        return Path(value)
    if key == "actions":
        return [str(part) for part in (value if isinstance(value, list) else [value])]
    if isinstance(value, list):
        return ",".join(map(str, value))
    numbers = ("theta_low", "theta_high", "noise", "names", "units")
    return str(value) if key in numbers else value


def declared_by(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return where everything is that a program wrote, as other commands need it."""
    if arguments.simulator is None:
        raise ValueError(
            "expected --simulator; got none; name it, as in --simulator my_robot.py:fn"
        )
    actions = arguments.actions or []
    is_named = len(actions) == 1 and not actions[0].partition(":")[0][:1].isdigit()
    return {
        "simulator": arguments.simulator,
        "effects": arguments.effects,
        "noise": arguments.noise,
        "prior": arguments.prior,
        "actions": actions[0] if is_named and ":" in actions[0] else None,
        "folder": os.getcwd(),
    }


def declared_of_task(name: str, options: Sequence[str]) -> dict[str, Any]:
    """Return the same for a campaign on a task.

    Args:
        name: Of the task.
        options: Of the task, each NAME=VALUE.
    """
    return {"task": name, "options": [*options], "noise": None, "folder": os.getcwd()}


def simulator_of(declared: Mapping[str, Any]) -> Any:
    """Return the simulator that was declared, with the noise of --noise.

    Raises:
        ValueError: If it is not there, or no function.
    """
    if "task" in declared:
        return make_task(declared["task"], declared["options"]).simulator
    found = load_object(_located(declared["simulator"], declared["folder"]))
    if not callable(found):
        raise ValueError(
            f"expected a function or SimulatorModel; got {type(found).__name__} under "
            f"{declared['simulator']}; name what takes (theta, action)"
        )
    return with_noise(found, declared["noise"])


def effects_of(declared: Mapping[str, Any]) -> list[Effect]:
    """Return the effects that were declared."""
    if declared.get("effects") is None:
        return []
    found = load_object(_located(declared["effects"], declared["folder"]))
    listed: Any = found() if callable(found) else found
    return [*listed]


def _not_described(declared: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the prior and the actions that the campaign's files do not describe."""
    manifest = read_manifest(folder)
    lacking = [what for what in ("prior", "actions") if manifest[what] is None]
    if "task" in declared and lacking:
        task = make_task(declared["task"], declared["options"])
        return {what: getattr(task, what) for what in lacking}
    named = [what for what in lacking if declared.get(what)]
    return {w: load_object(_located(declared[w], declared["folder"])) for w in named}


def _located(name: str, folder: str) -> str:
    """Return MODULE:NAME with a file's path from where the campaign was made."""
    module, separator, attribute = name.partition(":")
    if not module.endswith(".py"):
        sys.path.insert(0, folder)
        return name
    return f"{Path(folder, module)}{separator}{attribute}"


def open_campaign(arguments: argparse.Namespace, *, simulates: bool) -> Campaign:
    """Return the campaign of a folder.

    Args:
        arguments: With the folder.
        simulates: Whether its simulator is needed.

    Raises:
        ValueError: If there is no campaign, or nobody knows where its simulator is.
    """
    folder, declared = Path(arguments.folder), _read_declared(Path(arguments.folder))
    if getattr(arguments, "simulator", None) is not None:
        declared |= {"simulator": arguments.simulator, "folder": os.getcwd()}
        declared.pop("task", None)
    if not arguments.trust:
        _require_outside(folder, declared, arguments, simulates=simulates)
    given = _not_described(declared, folder)
    reader = Campaign.load(folder, **given)
    if not simulates:
        return reader
    if declared.keys().isdisjoint(("simulator", "task")):
        raise ValueError(
            f"expected --simulator, since the campaign in {folder} was made by a "
            "program; got none; name it, as in --simulator my_robot.py:fn"
        )
    simulator, effects = simulator_of({"noise": None, **declared}), effects_of(declared)
    if reader.state.version.effects:
        effects = _with_usual(effects, simulator, reader)
    return Campaign.load(folder, simulator=simulator, effects=effects, **given)


def _read_declared(folder: Path) -> dict[str, Any]:
    """Return how the command line made a campaign; nothing where it did not."""
    path = folder / DECLARED
    if not path.exists():
        return {}
    try:
        declared = json.loads(path.read_bytes())
        texts = (declared.get(n) for n in ("simulator", "prior", "actions", "effects"))
        is_whole = all(text is None or isinstance(text, str) for text in texts)
        is_whole &= isinstance(declared.get("folder", ""), str)
    except (ValueError, AttributeError, RecursionError):
        is_whole = False
    if not is_whole:
        raise ValueError(
            f"expected {path} as sbi-active init wrote it; got something else; restore "
            "it from a copy, or name the simulator by --simulator"
        )
    return declared


def _require_outside(
    folder: Path,
    declared: Mapping[str, Any],
    arguments: argparse.Namespace,
    *,
    simulates: bool,
) -> None:
    """Raise where code would run that came with the folder.

    What reads runs no code that the command line does not name. What simulates runs the
    simulator that the folder names, unless that lies in the folder.
    """
    lacking = [w for w in ("prior", "actions") if read_manifest(folder)[w] is None]
    named = [declared[what] for what in lacking if declared.get(what)]
    if not simulates:
        if "task" not in declared and named:
            raise ValueError(
                f"expected --trust, since the campaign's {lacking[0]} is Python code, "
                f"{named[0]}; got none; look at it, and add --trust to run it"
            )
        return
    if "task" in declared:
        return
    named += [declared[what] for what in ("simulator", "effects") if declared.get(what)]
    inside = folder.resolve()
    places = [Path.cwd(), Path(declared.get("folder", "."))]
    for name in named:
        module = name.partition(":")[0]
        if module.endswith(".py"):
            places.append(Path(declared.get("folder", "."), module))
    for place in places:
        place = place.resolve()
        if place == inside or inside in place.parents:
            raise ValueError(
                f"expected --trust, since {', '.join(named)} would be imported from "
                f"the campaign's own folder, {inside}; got none; look at the code "
                "there, and add --trust to run it"
            )


def library_of(campaign: Campaign) -> list[Effect]:
    """Return the effects to compare: the campaign's own, and those that are usual."""
    # An adopted effect is declared for the simulator without it.
    base = getattr(campaign.simulator, "base", campaign.simulator)
    return _with_usual([*campaign.effects], base, campaign)


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


def named_effects(arguments: argparse.Namespace) -> list[Effect]:
    """Return the effects that --effects names."""
    if arguments.effects is None:
        return []
    named: Any = load_object(arguments.effects)
    if callable(named):
        named = named()
    found = [*named]
    wrong = [e for e in found if not isinstance(e, Effect)]
    if wrong:
        raise ValueError(
            f"expected a list of Effect under {arguments.effects}; got "
            f"{type(wrong[0]).__name__} in it; declare sbi_active.criticism.Effect"
        )
    return found
