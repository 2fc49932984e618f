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
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

#: How the command line made the campaign: where its simulator is.
DECLARED = "command.json"
#: What else makes a folder a campaign's, see :mod:`sbi_active.campaign.storage`.
MANIFESTS = ("store.db", "campaign.json")
#: Options of ``init`` and ``run`` that are kept, and where their paths begin; and the
#: types of their values, or of the entries of a list.
TEXTS = ("simulator", "task", "prior", "names", "units", "folder")
LISTS = {
    **dict.fromkeys(("option", "actions", "effects"), str),
    **dict.fromkeys(("theta_low", "theta_high", "noise"), float),
}


def in_campaign(path: Path) -> bool:
    """Return whether a folder is a campaign's, or within one."""
    places = (path.resolve(), *path.resolve().parents)
    return any((place / name).exists() for place in places for name in MANIFESTS)


def names_object(specs: Sequence[str]) -> bool:
    """Return whether --actions is MODULE:NAME, and no numbers."""
    is_number = any(re.match(r"[-+]?\.?\d", spec) for spec in specs)
    return len(specs) == 1 and specs[0].count(":") == 1 and not is_number


def absolute(name: str) -> str:
    """Return MODULE:NAME with the whole path of a file."""
    module, colon, attribute = name.partition(":")
    module = str(Path(module).resolve()) if module.endswith(".py") else module
    return f"{module}{colon}{attribute}"


def read_declared(folder: Path) -> dict[str, Any]:
    """Return the options that made a campaign; none if it was made by a program.

    Raises:
        ValueError: If the file does not hold what the command line writes.
    """
    path = folder / DECLARED
    found: Any = None
    with suppress(ValueError, RecursionError):
        found = json.loads(path.read_bytes()) if path.exists() else {}
    if isinstance(found, dict):
        kept = {k: found[k] for k in (*TEXTS, *LISTS) if found.get(k) is not None}
        if all(_is_kept(name, value) for name, value in kept.items()):
            return {"simulator": None, **kept}
    raise ValueError(
        f"expected {path} as sbi-active writes it; got another content; remove the "
        "file, and name the simulator by --simulator"
    )


def _is_kept(name: str, value: Any) -> bool:
    if name in TEXTS:
        return isinstance(value, str)
    return isinstance(value, list) and all(type(v) is LISTS[name] for v in value)


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


def require_trust(
    folder: Path, declared: Mapping[str, Any], *, own: str | None, trusts: bool
) -> None:
    """Raise if nobody here said that what a folder names may be executed.

    A relative place, or one within a campaign, holds whatever somebody put there.

    Args:
        folder: Folder of the campaign.
        declared: Options that the folder declares.
        own: Simulator that the command line names in place of the folder's.
        trusts: Whether the command line says to import it, whoever wrote it.
    """
    names = [] if own else [declared["simulator"]]
    names += [declared.get("prior"), *declared.get("effects", ())]
    names += [spec for spec in declared.get("actions", ()) if names_object([spec])]
    origin, options = Path(declared.get("folder", "")), declared.get("option", ())
    modules = [name.partition(":")[0] for name in filter(None, names)]
    places = [origin / m if m.endswith(".py") else origin for m in modules]
    is_fixed = all(p.is_absolute() and not in_campaign(p) for p in places)
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
