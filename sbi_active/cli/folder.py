"""A campaign's folder and the programs that the command line declared for it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sbi_active.campaign import Campaign
from sbi_active.campaign.storage.damage import naming
from sbi_active.campaign.storage.manifest import read_manifest
from sbi_active.cli.declared import named, read_declared, require_trust
from sbi_active.cli.given import (
    effects_of,
    load_object,
    make_task,
    simulator_of,
    with_generic,
)
from sbi_active.criticism import Effect
from sbi_active.simulation.bank.store import Store


def open_campaign(
    folder: Path,
    *,
    simulates: bool,
    simulator: str | None = None,
    trust: bool = False,
    simulator_changed: bool = False,
    repair: bool = False,
) -> Campaign:
    """Return the campaign of a folder.

    Args:
        folder: Of the campaign.
        simulates: Whether its simulator is needed; else nothing of the folder is
            imported without --trust.
        simulator: Where that is; None where the folder says.
        trust: Whether to import what the folder names.
        simulator_changed: Take another simulator than before.
        repair: Give up what is damaged.

    Raises:
        ValueError: If there is no campaign, or nobody knows where its simulator is, or
            only the folder says so.
    """
    declared = read_declared(folder)
    given = {}
    if simulates or trust and declared:
        given = _given(folder, declared, trusts=trust)
    reader = Campaign.load(folder, repair=repair, **given)
    if not simulates:
        return reader
    model = _simulator_of(simulator, declared, folder, trusts=trust)
    names = named(declared, "effects", folder, trusts=trust)
    effects = effects_of(names, declared.get("folder"))
    if reader.state.version.effects:
        effects = _with_usual(effects, model, reader)
    changed = {"simulator_changed": simulator_changed}
    return Campaign.load(folder, simulator=model, effects=effects, **changed, **given)


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


def _simulator_of(
    name: str | None, declared: Mapping[str, Any], folder: Path, *, trusts: bool
) -> Any:
    if name is not None:
        return simulator_of(name, declared.get("noise"))
    if declared.get("task") is not None:
        return _task_of(declared, folder, trusts=trusts).simulator
    names = named(declared, "simulator", folder, trusts=trusts)
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
    return with_generic(own, simulator, reader.actions, reader.first_prior)
