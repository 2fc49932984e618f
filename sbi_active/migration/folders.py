"""A folder of release 0.1, a bank's or a campaign's, as the one file of today."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sbi_active.campaign.storage.directory import FOR_PEOPLE, make_campaign
from sbi_active.campaign.telling import LOG
from sbi_active.messages import warn
from sbi_active.migration.described import actions_from, options_from, prior_from
from sbi_active.migration.segments import copy_bank
from sbi_active.simulation.bank.store import (
    NAME,
    TEMPORARY,
    Store,
    synchronize,
    whole,
)

BEFORE = "version-1"  # gets the files of before
#: What release 0.1 wrote into a folder.
OWN = re.compile(
    r"campaign\.json(\.copy)?|trials\.jsonl|trials\.damaged(-\d+)?|state\.bin(\.damaged)?"
    r"|belief-[0-9a-f]+\.bin|simulations(-\d+)?|writer\.(lock|json)|bank\.json|segments"
)


def migrate(folder: Path) -> dict[str, int]:
    """Bring a bank, several in a folder, or a campaign of release 0.1 up to date.

    The former files are kept in a subfolder "version-1". An interrupted migration is
    done again.

    Args:
        folder: Folder of the campaign or bank, or that of ``CampaignOptions(bank=)``.

    Returns:
        Number of rows by bank; of a campaign also the number of its events, as "log".

    Raises:
        ValueError: If there is nothing of release 0.1 in it.
        CorruptSegmentError: If a bank, the log or the manifest is not what was written.
        ImportError: If there are rows, and no h5py to read them.
    """
    banks = _banks(folder)
    is_campaign = (folder / "campaign.json").exists()
    if not (banks or is_campaign):
        raise ValueError(
            f"expected a bank or campaign of release 0.1; got {folder} without one; "
            "name its folder"
        )
    found: dict[str, int] = {}
    if not (folder / NAME).exists():
        made = folder / f"{TEMPORARY}{BEFORE}"
        shutil.rmtree(made, ignore_errors=True)
        if is_campaign:
            found["log"] = _copy_campaign(folder, made)
        store = Store(made, make=True)
        for name, place in banks.items():
            found[name] = copy_bank(place, store, name)
        store.close()
        for name in (FOR_PEOPLE, NAME):
            if (made / name).exists():
                os.replace(made / name, folder / name)
        synchronize(folder)
        shutil.rmtree(made)
    (folder / BEFORE).mkdir(exist_ok=True)
    within = [place.relative_to(folder) for place in banks.values() if place != folder]
    tops = {place.parts[0] for place in within}
    for path in [*folder.iterdir()]:
        if OWN.fullmatch(path.name) or path.name in tops:
            os.replace(path, folder / BEFORE / path.name)
    synchronize(folder)
    return found


def _banks(folder: Path) -> dict[str, Path]:
    """Return the banks in a folder by the names that they have in a store."""
    found = {}
    for path in sorted(folder.glob("**/bank.json")):
        *above, name = ("rows", *path.relative_to(folder).parts[:-1])
        change = re.fullmatch(r"simulations-(\d+)", above[-1] if above else "")
        if BEFORE not in above and len(above) < 3:
            found[f"{name}-changed-{change[1]}" if change else name] = path.parent
    return found


def _copy_campaign(folder: Path, made: Path) -> int:
    """Write what a campaign was and its log; all else is computed again."""
    manifest = _manifest(folder)
    readers = {"prior": prior_from, "actions": actions_from, "options": options_from}
    described = {what: manifest.pop(what) for what in readers}
    given = {
        what: read(described[what])
        for what, read in readers.items()
        if described[what] is not None
    }
    limits = [what for what in ("cost", "constraint") if manifest.pop(f"has_{what}")]
    make_campaign(made, given, {**manifest, "limits": limits})
    store = Store(made, "campaign")
    entries = _entries(folder / "trials.jsonl")
    for entry in entries:
        with store.writing():
            store.append(LOG, entry)
    store.close()
    return len(entries)


def _manifest(folder: Path) -> dict[str, Any]:
    path = folder / "campaign.json"
    for place in (path, folder / "campaign.json.copy"):
        try:
            manifest = json.loads(place.read_bytes())
            digest = manifest.pop("sha256")
            text = json.dumps(manifest, sort_keys=True)
            if digest == hashlib.sha256(text.encode()).hexdigest():
                if manifest.get("schema") == 1:
                    return manifest
                raise ValueError(
                    f"expected a campaign of schema 1; got {manifest.get('schema')} in "
                    f"{place}; use the release of sbi-active that wrote it"
                )
        except (OSError, KeyError, AttributeError, TypeError, json.JSONDecodeError):
            continue
    whole(path, False, "a manifest with another checksum")
    return {}


def _entries(path: Path) -> list[Mapping[str, Any]]:
    """Return the lines of a log; one that was not finished is none, which is said."""
    *lines, rest = (path.read_bytes() if path.exists() else b"").split(b"\n")
    if rest:
        text = f"SA610 {path} ends within line {len(lines) + 1}, which is left out:"
        warn(f"{text} {rest!r:.200}")
    entries = []
    for number, line in enumerate(lines, 1):
        head, _, tail = line.rpartition(b', "crc": "')
        text = head + b"}"
        if tail != f'{zlib.crc32(text):08x}"}}'.encode():
            text = f"line {number} with another checksum: open it by release 0.1"
            whole(path, False, text)
        entries.append(json.loads(text))
    return entries
