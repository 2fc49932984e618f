"""What a campaign is: written once, with a copy, and in words for people."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Mapping
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

from sbi_active.campaign.state import CampaignState
from sbi_active.campaign.storage.codec import NotStorableError, encode
from sbi_active.campaign.storage.drawn import drawn
from sbi_active.campaign.telling import now
from sbi_active.simulation.bank.fingerprint import fingerprint
from sbi_active.simulation.bank.sqlite import NAME, sensible
from sbi_active.simulation.bank.store import Store

MANIFEST, COPY, FOR_PEOPLE = "campaign", "campaign copy", "campaign.toml"
FORMAT, SCHEMA = "sbi-active campaign", 3  # schema 1 was a folder of files
UNTOLD = ("packages", "simulator")  # what people are not told


def make_campaign(
    folder: Path,
    state: CampaignState,
    given: Mapping[str, Any],
    simulator: Callable[..., Any],
    **facts: Any,
) -> None:
    """Write what a new campaign is.

    Args:
        folder: Folder, which is made where there is none.
        state: State of the campaign.
        given: Prior, actions and options.
        simulator: Simulator of the campaign.
        **facts: Facts to note, as JSON data.

    Raises:
        ValueError: If the folder holds anything.
        OSError: If it cannot be written.
    """
    objects: dict[str, bytes] = {}
    for what, thing in given.items():
        with suppress(NotStorableError):
            objects[what] = encode(thing, known={})
    own = [what for what in given if what not in objects]
    for what in {*own} - {"options"}:
        objects[what] = encode(drawn(given[what], seed=state.seed), known={})
    packages = {name: version(name) for name in ("sbi-active", "sbi", "torch", "numpy")}
    declared = ("parameter_names", "channel_names")
    names = {name: getattr(simulator, name, None) for name in declared}
    manifest = {
        "created": now(),
        "packages": {"python": platform.python_version(), **packages},
        "method": state.method,
        "seed": state.seed,
        "num_earlier": state.num_earlier,
        **{name: found if found is None else [*found] for name, found in names.items()},
        **facts,
        **{f"{what}_text": repr(thing) for what, thing in given.items()},
        "own": own,
        "simulator": fingerprint(simulator),
    }
    write_campaign(folder, manifest, objects)


def write_campaign(
    folder: Path, manifest: Mapping[str, Any], objects: Mapping[str, bytes]
) -> None:
    """Write a manifest, with a copy, the objects beside it, and a text for people.

    Raises:
        ValueError: If the folder holds anything.
        OSError: If it cannot be written.
    """
    store = Store(folder, "campaign", make=True)
    if {*store.catalog} - {"writer"}:
        raise ValueError(
            f"expected an empty folder for a new campaign; got {folder} with a "
            "campaign; go on with it by Campaign.load(directory, simulator=...), or "
            "choose another folder"
        )
    records = {MANIFEST: {**manifest, "format": FORMAT, "schema": SCHEMA}, **objects}
    with store.writing():
        for kind, content in {**records, COPY: records[MANIFEST]}.items():
            store.put(kind, 0, content)
    store.close()
    heading = f"# What this campaign is, for people. All is kept in {NAME}; this is not"
    # A text of JSON is one of TOML.
    plain = {k: v for k, v in manifest.items() if v is not None and k not in UNTOLD}
    lines = [f"{k.removesuffix('_text')} = {json.dumps(v)}" for k, v in plain.items()]
    text = "\n".join([f"{heading} read.", *lines, ""])
    (folder / FOR_PEOPLE).write_text(text, encoding="utf-8")


def has_manifest(folder: Path) -> bool:
    """Return whether a folder holds a campaign, damaged or of before or not."""
    if not (folder / NAME).exists():
        return (folder / "campaign.json").exists()
    try:
        return MANIFEST in Store(folder, "campaign").catalog
    except OSError:
        return True


def read_manifest(store: Store) -> dict[str, Any]:
    """Return what a campaign is; from the copy where a repair gave up the first.

    Raises:
        ValueError: If there is none, or one of another schema.
        CorruptSegmentError: If it does not hold what was written.
    """
    manifest = store.json(MANIFEST) or store.json(COPY)
    if manifest is None:
        raise ValueError(
            f"expected a folder with a campaign; got {store.folder} without one; make "
            "it by Campaign(..., directory=...)"
        )
    if (manifest.get("format"), manifest.get("schema")) != (FORMAT, SCHEMA):
        with sensible(store.path):
            release = manifest["packages"]["sbi-active"]
        raise ValueError(
            f"expected a campaign of schema {SCHEMA}; got {manifest.get('schema')} in "
            f"{store.path}; use the release of sbi-active that wrote it: {release}"
        )
    return manifest
