"""The programs that a campaign's folder names, and whether to trust it.

A folder may come from an untrusted source. Programs that its ``command.json`` names are
imported if this account wrote that file, or was told once by ``--trust`` to follow it;
both are remembered outside of the folder. Nothing here imports torch.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from sbi_active.cli.declare import beside

#: How the command line made the campaign: where its simulator is.
DECLARED = "command.json"
#: What else makes a folder a campaign's, see :mod:`sbi_active.campaign.storage`.
MANIFESTS = ("store.db", "campaign.json")


def in_campaign(path: Path) -> bool:
    """Return whether a folder is a campaign's, or within one."""
    places = (path.resolve(), *path.resolve().parents)
    return any((place / name).exists() for place in places for name in MANIFESTS)


def names_object(spec: str) -> bool:
    """Return whether a part of --actions is MODULE:NAME, and no numbers."""
    return spec.count(":") == 1 and not re.match(r"[-+]?\.?\d", spec)


def read_declared(folder: Path) -> dict[str, Any]:
    """Return the options that made a campaign; none if it was made by a program.

    Raises:
        ValueError: If the file does not hold what the command line writes.
    """
    path = folder / DECLARED
    found: Any = None
    with suppress(ValueError, RecursionError):
        found = json.loads(path.read_bytes()) if path.exists() else {}
    if isinstance(found, dict) and all(map(_is_option, found.values())):
        origin = Path(found.get("folder", ""))
        return {name: beside(origin, value) for name, value in found.items()}
    raise ValueError(
        f"expected {path} as sbi-active writes it; got another content; remove the "
        "file, and name the simulator by --simulator"
    )


def _is_option(value: Any) -> bool:
    """Return whether a value is a text, or a list of texts or of numbers."""
    parts = value if isinstance(value, list) else [value]
    return not isinstance(value, float) and {*map(type, parts)} in ({str}, {float})


def write_declared(path: Path, **options: Any) -> None:
    """Write where everything is, and remember that it was written here.

    Args:
        path: Folder of the campaign.
        **options: Options by name; paths begin in the current folder otherwise.
    """
    kept = {"folder": os.getcwd(), **{k: v for k, v in options.items() if v}}
    temporary = path / f".writing-{os.getpid()}-{DECLARED}"
    temporary.write_text(json.dumps(kept, indent=2) + "\n", encoding="utf-8")
    os.replace(temporary, path / DECLARED)
    _remember(path)


def require_trust(folder: Path, declared: Mapping[str, Any], *, trusts: bool) -> None:
    """Raise if nobody here said that what a folder names may be executed.

    A relative place, or one within a campaign, holds whatever somebody put there.

    Args:
        folder: Folder of the campaign.
        declared: Options that the folder declares.
        trusts: Whether the command line says to import it, whoever wrote it.
    """
    names = [declared.get("simulator"), declared.get("prior")]
    names += declared.get("effects", [])
    names += filter(names_object, declared.get("actions", []))
    origin, options = declared.get("folder", ""), declared.get("option", ())
    modules = [name.partition(":")[0] for name in filter(None, names)]
    places = [Path(m if m.endswith(".py") else origin) for m in modules]
    is_fixed = all(place.is_absolute() and not in_campaign(place) for place in places)
    if trusts and is_fixed:
        _remember(folder)
    # Options of a task may name files.
    is_known = trusts or is_fixed and _record(folder).exists()
    if not is_known and (places or options):
        what = ", ".join([*filter(None, names), *options])
        raise ValueError(
            f"expected programs that were named here; got {what} in {origin}, which "
            f"{DECLARED} in {folder} names and this account did not write or trust; "
            "look at it, then add --trust to have it executed, or name your own by "
            "--simulator"
        )


def _remember(folder: Path) -> None:
    record = _record(folder)
    with suppress(OSError):  # as in a home that is read only: --trust each time
        record.parent.mkdir(parents=True, exist_ok=True)
        record.touch()


def _record(folder: Path) -> Path:
    """Return the file, outside of the folder, that stands for its ``command.json``."""
    home = os.environ.get("XDG_STATE_HOME") or os.path.expanduser("~/.local/state")
    path = folder / DECLARED
    content = path.read_bytes() if path.exists() else b""
    return Path(home, "sbi-active", "trusted", hashlib.sha256(content).hexdigest())
