"""What a bank says of itself: format, simulator, shapes and names."""

from __future__ import annotations

import json
import uuid
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sbi_active.simulation.bank.damage import (
    LARGEST_TEXT,
    is_count,
    parsed,
    regular_size,
    require,
)
from sbi_active.simulation.bank.files import TEMPORARY, write_file
from sbi_active.simulation.bank.fingerprint import differences

FORMAT = 1
HEADER = "bank.json"

#: Files of a bank whose header is not written yet.
OWN = ("segments", "writer.json", "writer.lock")


def new_header(
    identity: Mapping[str, Any], *, names: Sequence[str] | None, created: str | None
) -> dict[str, Any]:
    """Return the header of an empty bank.

    Args:
        identity: Fingerprint of the simulator.
        names: Of the parameters.
        created: Date.
    """
    return {
        "format": FORMAT,
        "id": uuid.uuid4().hex,  # tells its segments from those of other banks
        "created": created,
        **identity,
        "parameter_names": names,
        "shapes": None,
        "num_segments": 0,  # as of the last time that a writer closed the bank
        "lost": [],  # numbers, first to last, of segments that were given up
    }


def has_header(folder: Path) -> bool:
    """Return whether a folder holds a bank."""
    return (folder / HEADER).exists()


def make_folder(folder: Path, name: str) -> None:
    """Make the folder of a bank with one inside.

    Raises:
        ValueError: If it holds anything else.
        OSError: If it cannot be made.
    """
    try:
        (folder / name).mkdir(parents=True, exist_ok=True)
        found = sorted(path.name for path in folder.iterdir())
    except OSError as error:
        raise type(error)(
            error.errno,
            f"expected a folder that can be made for a bank; got {error.strerror!r}; "
            "choose a place that can be written",
            str(folder),
        ) from error
    other = [f for f in found if f not in OWN and not f.startswith(TEMPORARY)]
    if other:
        raise ValueError(
            f"expected a bank or an empty folder; got {folder} with {other[0]!r}; "
            "choose another folder"
        )


def write_header(folder: Path, header: Mapping[str, Any]) -> None:
    """Write the header, atomically."""
    write_file(folder / HEADER, (json.dumps(header, indent=2) + "\n").encode())


def read_header(folder: Path) -> dict[str, Any]:
    """Return the header.

    Raises:
        ValueError: If there is none, or one of another format.
        CorruptSegmentError: If it is not what a bank writes.
    """
    path = folder / HEADER
    try:
        size = regular_size(path)
        require(path, size <= LARGEST_TEXT, f"a text of {size} bytes")
        header = parsed(path, path.read_bytes())
    except (FileNotFoundError, NotADirectoryError) as error:
        raise ValueError(
            f"expected a bank; got no {path}; give simulator= to make one"
        ) from error
    found = header.get("format")
    require(path, type(found) is int, "no header (it tells no format)")
    if found != FORMAT:
        raise ValueError(
            f"expected a bank of format {FORMAT}; got {found} in {path}; use the "
            "release of sbi-active that wrote it, or make a new bank"
        )
    header = {"id": None, "num_segments": 0, "lost": [], **header}  # older ones lack it
    for name, is_valid in _ENTRIES.items():
        require(path, name in header, f"no entry {name!r}")
        require(path, is_valid(header[name]), f"an entry {name!r} that none writes")
    return header


def _is_text(value: Any) -> bool:
    return value is None or isinstance(value, str)


def _are_names(value: Any) -> bool:
    is_list = isinstance(value, list)
    return value is None or (is_list and all(isinstance(v, str) for v in value))


def _are_shapes(value: Any) -> bool:
    return value is None or (
        isinstance(value, dict)
        and value.keys() == {"theta", "action", "x"}
        and all(isinstance(v, list) and all(map(is_count, v)) for v in value.values())
    )


def _are_ranges(value: Any) -> bool:
    return isinstance(value, list) and all(
        isinstance(v, list) and len(v) == 2 and all(map(is_count, v)) for v in value
    )


_ENTRIES: dict[str, Callable[[Any], bool]] = {
    "id": _is_text,
    "created": _is_text,
    "version": lambda value: isinstance(value, str),
    "simulator": lambda value: isinstance(value, dict | str),
    "parameter_names": _are_names,
    "shapes": _are_shapes,
    "num_segments": is_count,
    "lost": _are_ranges,
}


def require_same_simulator(
    folder: Path, stored: Mapping[str, Any], mine: Mapping[str, Any]
) -> None:
    """Compare the header on the disk with that of the simulator at hand.

    Raises:
        ValueError: If simulator, version or names differ; the text says where.
    """
    lines = differences(stored, mine)
    names = stored["parameter_names"], mine["parameter_names"]
    if None not in names and names[0] != names[1]:
        lines.append(f"parameter names {names[0]} there, {names[1]} here")
    if lines:
        raise ValueError(
            f"expected the simulator of the bank {folder}; got another: "
            f"{'; '.join(lines)}; make a bank for each simulator, or, where x is "
            "the same, give the same version= each time and keep what changes from "
            "call to call in attributes with a leading underscore"
        )
