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

TEXTS = ("simulator", "noise", "prior", "actions", "folder", "task")
LISTS = ("effects", "options")


def in_campaign(path: Path) -> bool:
    """Return whether a folder is a campaign's, or within one."""
    places = (path.resolve(), *path.resolve().parents)
    return any((place / name).exists() for place in places for name in MANIFESTS)


def names_object(specs: Sequence[str]) -> bool:
    """Return whether --actions is MODULE:NAME, and no numbers."""
    is_number = any(re.match(r"[-+]?\.?\d", spec) for spec in specs)
    return len(specs) == 1 and specs[0].count(":") == 1 and not is_number


def declare(
    *,
    simulator: str | None,
    noise: str | None,
    prior: str | None,
    actions: Sequence[str],
    effects: str | None,
    **_: Any,
) -> dict[str, Any]:
    """Return the places of all that a program wrote, as other commands need them."""
    if simulator is None:
        raise ValueError(
            "expected --simulator; got none; name it, as in --simulator my_robot.py:fn"
        )
    return {
        "simulator": simulator,
        "effects": [] if effects is None else [effects],
        "noise": noise,
        "prior": prior,
        "actions": actions[0] if names_object(actions) else None,
        "folder": os.getcwd(),
    }


def declared_of_task(name: str, options: Sequence[str]) -> dict[str, Any]:
    """Return the declaration of a campaign on a task.

    Args:
        name: Name of the task.
        options: Options of the task, each NAME=VALUE.
    """
    return {"task": name, "options": [*options], "noise": None, "folder": os.getcwd()}


def read_declared(folder: Path) -> dict[str, Any]:
    """Return the declaration in a campaign's folder; empty for a campaign of a program.

    Raises:
        ValueError: If the file does not hold what the command line writes.
    """
    path = folder / DECLARED
    found: Any = None
    with suppress(ValueError, RecursionError):
        found = json.loads(path.read_bytes()) if path.exists() else {}
    if isinstance(found, dict):
        found = {**dict.fromkeys(LISTS, []), **found}
        is_text = [isinstance(found.get(name), str | None) for name in TEXTS]
        if all(is_text) and all(_is_texts(found[name]) for name in LISTS):
            return found
    raise ValueError(
        f"expected {path} as sbi-active writes it; got another content; remove the "
        "file, and name the simulator by --simulator"
    )


def _is_texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(part, str) for part in value)


def write_declared(folder: Path, declared: Mapping[str, Any]) -> None:
    """Write where everything is, and remember that it was written here."""
    temporary = folder / f".writing-{os.getpid()}-{DECLARED}"
    temporary.write_text(json.dumps(declared, indent=2) + "\n", encoding="utf-8")
    os.replace(temporary, folder / DECLARED)
    _remember(folder)


class Declared:
    """Programs that the folder of a campaign names, where they may be imported.

    Args:
        folder: Folder of the campaign.
        trusts: Whether the command line says to import it, whoever wrote it.

    Attributes:
        task: Name of the task, for a campaign on a task.
        noise: Noise as --noise had it.
        place: Folder where names of files begin.
    """

    def __init__(self, folder: Path, *, trusts: bool) -> None:
        self._folder, self._trusts = folder, trusts
        self._content = read_declared(folder)
        texts = (self._content.get(name) for name in ("task", "noise", "folder"))
        self.task, self.noise, self.place = texts

    def names(self, what: str) -> list[str]:
        """Return the names under a key of the folder, each MODULE:NAME.

        Raises:
            ValueError: If it names something that may be anybody's program.
        """
        value, origin = self._content.get(what) or [], Path(self.place or "")
        names = value if isinstance(value, list) else [value]
        for name in names:
            module = name.partition(":")[0]
            place = origin / module if module.endswith(".py") else origin
            self._require_trust(f"{name} in {origin}", place)
        return names

    @property
    def options(self) -> list[str]:
        """Return the options of the task, of which some name files.

        Raises:
            ValueError: If one names something that may be anybody's program.
        """
        options = self._content["options"]
        if options:
            self._require_trust(f"options {' '.join(options)} of a task", None)
        return options

    def _require_trust(self, what: str, place: Path | None) -> None:
        """Raise if nobody here said that what comes from a place may be executed.

        None is this library. A relative place, or one within the folder, holds whatever
        somebody put there.
        """
        folder = self._folder
        is_fixed = place is None or (
            place.is_absolute() and not _is_within(place, folder)
        )
        if self._trusts:
            if is_fixed:
                _remember(folder)
        elif not (is_fixed and _record(folder).exists()):
            raise ValueError(
                f"expected programs that were named here; got {what}, which {DECLARED} "
                f"in {folder} names and this account did not write or trust; look at "
                "it, then add --trust to have it executed, or name your own by "
                "--simulator"
            )


def _is_within(place: Path, folder: Path) -> bool:
    inner, outer = place.resolve(), folder.resolve()
    return outer in (inner, *inner.parents) or in_campaign(inner)


def _remember(folder: Path) -> None:
    record = _record(folder)
    with suppress(OSError):  # as in a home that is read only: --trust each time
        record.parent.mkdir(parents=True, exist_ok=True)
        record.touch()


def _record(folder: Path) -> Path:
    """Return the file, outside of the folder, that stands for its ``command.json``."""
    home = os.environ.get("XDG_STATE_HOME") or os.path.expanduser("~/.local/state")
    digest = hashlib.sha256((folder / DECLARED).read_bytes()).hexdigest()
    return Path(home, "sbi-active", "trusted", digest)
