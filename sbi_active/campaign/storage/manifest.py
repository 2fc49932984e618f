"""The description of a campaign: written once, with a copy, and in words for people."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.campaign.state import CampaignState
from sbi_active.campaign.storage.damage import DamagedCampaignError
from sbi_active.campaign.storage.described import (
    describe_actions,
    describe_options,
    describe_prior,
)
from sbi_active.campaign.storage.drawn import draws_of
from sbi_active.simulation.bank.damage import CorruptSegmentError
from sbi_active.simulation.bank.files import write_file
from sbi_active.simulation.bank.fingerprint import differences, fingerprint
from sbi_active.simulation.bank.sqlite import EVENTS, NAME, OBJECTS
from sbi_active.simulation.bank.store import Store

MANIFEST, FOR_PEOPLE = "campaign", "campaign.toml"
FORMAT, SCHEMA = "sbi-active campaign", 2  # schema 1 was a folder of files
PLAIN = (
    *("created", "method", "seed", "parameter_names", "channel_names", "x_shape"),
    *("effects", "has_cost", "has_constraint"),
)
DESCRIBED = ("prior", "actions", "options")
PACKAGES = ("sbi-active", "sbi", "torch", "numpy")


def new_manifest(
    state: CampaignState,
    *,
    simulator: Callable[..., Any],
    prior: Distribution,
    actions: ActionSpace,
    x_shape: Sequence[int],
    effects: Sequence[str],
    has_cost: bool,
    has_constraint: bool,
) -> dict[str, Any]:
    """Return the description of a new campaign.

    Args:
        state: State of the campaign.
        simulator: Simulator of the campaign.
        prior: Prior of the campaign.
        actions: Action space of the campaign.
        x_shape: Shape of an outcome.
        effects: Names of those that the simulator may lack.
        has_cost: Whether actions have a cost, which the reader must give again.
        has_constraint: Whether actions have a constraint, which the reader must give
            again.
    """
    names = getattr(simulator, "parameter_names", None)
    channels = getattr(simulator, "channel_names", None)
    described = {"prior": describe_prior(prior), "actions": describe_actions(actions)}
    return {
        "format": FORMAT,
        "schema": SCHEMA,
        "created": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "packages": _packages(),
        "method": state.method,
        "seed": state.seed,
        "num_earlier": state.num_earlier,
        "parameter_names": None if names is None else [*names],
        "channel_names": None if channels is None else [*channels],
        "x_shape": [*x_shape],
        "prior": described["prior"],
        "prior_text": repr(prior),
        "actions": described["actions"],
        "actions_text": repr(actions),
        "options": describe_options(state.options),
        "options_text": repr(state.options),
        "drawn": {
            what: draws_of(thing, seed=state.seed)
            for what, thing in (("prior", prior), ("actions", actions))
            if described[what] is None
        },
        "effects": [*effects],
        "has_cost": has_cost,
        "has_constraint": has_constraint,
        "simulator": fingerprint(simulator),
    }


def has_manifest(folder: Path) -> bool:
    """Return whether a folder holds a campaign, damaged or of before or not."""
    if not (folder / NAME).exists():
        return (folder / "campaign.json").exists()
    try:
        return Store(folder, "campaign").size(OBJECTS, MANIFEST) is not None
    except OSError:
        return True


def write_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Write a manifest, its copy, and ``campaign.toml`` for people.

    Raises:
        ValueError: If the folder holds anything.
        OSError: If it cannot be written.
    """
    store = Store(folder, "campaign", make=True)
    if {*store.kinds()} - {"writer"}:
        raise ValueError(
            f"expected an empty folder for a new campaign; got {folder} with a "
            "campaign; go on with it by Campaign.load(directory, simulator=...), or "
            "choose another folder"
        )
    content = json.dumps(manifest).encode()
    with store.writing():
        for table in (OBJECTS, EVENTS):  # a copy, on other pages of the file
            store.put(table, MANIFEST, 0, content)
    write_file(folder / FOR_PEOPLE, _in_words(manifest).encode())
    store.close()


def read_manifest(store: Store, *, repair: bool = False) -> dict[str, Any]:
    """Return a manifest.

    Args:
        store: Store of the campaign.
        repair: Whether to take the copy where the manifest is damaged, and write it
            again.

    Raises:
        ValueError: If there is none, or one of another schema.
        DamagedCampaignError: If it does not hold what was written.
    """
    found = {table: _read(store, table) for table in (OBJECTS, EVENTS)}
    manifest = found[OBJECTS]
    if repair and not manifest and (manifest := found[EVENTS]):
        with store.writing():
            store.put(OBJECTS, MANIFEST, 0, json.dumps(manifest).encode())
        store.close()
    if manifest is None and found[EVENTS] is None:
        raise ValueError(
            f"expected a folder with a campaign; got {store.folder} without one; make "
            "it by Campaign(..., directory=...)"
        )
    if not manifest:
        raise DamagedCampaignError(
            store.path, "a manifest with another checksum, the log of the trials apart"
        )
    if manifest.get("format") != FORMAT or manifest.get("schema") != SCHEMA:
        raise ValueError(
            f"expected a campaign of schema {SCHEMA}; got "
            f"{manifest.get('format')!r} of schema {manifest.get('schema')} in "
            f"{store.path}; use the release of sbi-active that wrote it: "
            f"{manifest.get('packages', {}).get('sbi-active', 'unknown')}"
        )
    return manifest


def require_same_simulator(
    manifest: Mapping[str, Any], simulator: Callable[..., Any]
) -> None:
    """Raise if a simulator is not the one that the campaign was made with.

    Raises:
        ValueError: If they differ; it says where.
    """
    lines = differences(manifest["simulator"], fingerprint(simulator))
    if lines:
        raise ValueError(
            "expected the simulator of the campaign; got another: "
            f"{'; '.join(lines)}; pass the one it was made with, or "
            "simulator_changed=True to compute everything again with this one"
        )


def _read(store: Store, table: str) -> dict[str, Any] | None:
    """Return what is there; None for nothing, and nothing in it for damage."""
    try:
        content = store.get(table, MANIFEST)
        found = None if content is None else json.loads(content)
    except (CorruptSegmentError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict | None) else {}


def _in_words(manifest: Mapping[str, Any]) -> str:
    """Return a manifest as TOML; a text of JSON is one of TOML."""
    texts = {name: manifest[f"{name}_text"] for name in DESCRIBED}
    plain = {name: manifest[name] for name in PLAIN if manifest[name] is not None}
    lines = [f"{k} = {json.dumps(v)}" for k, v in {**plain, **texts}.items()]
    heading = f"# What this campaign is, for people. All is kept in {NAME}; this is not"
    return "\n".join([f"{heading} read.", *lines, ""])


def _packages() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found
