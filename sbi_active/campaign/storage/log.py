"""What was asked, told and decided, a line each, on the disk before it counts."""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from sbi_active.campaign.storage.damage import DamagedCampaignError
from sbi_active.simulation.bank.segments import synchronize, write_file


class TrialLog:
    """A file of JSON lines that is only ever added to.

    A line ends with the CRC-32 of what is before it. A last line that was not finished,
    as its writer was killed, is no line: nothing had returned that depends on it.

    Args:
        path: The file, made with the first line.

    Attributes:
        entries: The lines so far, without their checksums.

    Raises:
        DamagedCampaignError: If a line does not hold what was written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.entries, self._size = read_log(path)

    def __len__(self) -> int:
        return len(self.entries)

    def append(self, entry: Mapping[str, Any]) -> None:
        """Add a line; it is on the disk when this returns.

        Raises:
            OSError: If it cannot be written; the lines before are as they were.
        """
        time = datetime.now(timezone.utc).isoformat(timespec="seconds")
        line = {"line": len(self.entries) + 1, "time": time, **entry}
        content = _sealed(line)
        is_new = not self.path.exists()
        try:
            mode = "wb" if is_new else "r+b"
            with open(self.path, mode, buffering=0) as file:
                file.truncate(self._size)  # of a writer that was killed
                file.seek(self._size)
                try:
                    rest = memoryview(content)
                    while rest:  # a disk that gets full takes a part
                        rest = rest[file.write(rest) :]
                    os.fsync(file.fileno())
                except OSError:
                    file.truncate(self._size)
                    raise
        except OSError as error:
            raise type(error)(
                error.errno,
                f"expected to write {len(content)} bytes to the log of the trials; got "
                f"{error.strerror!r}; make room, or choose a place that can be "
                "written, and tell it again: what was told before is whole",
                str(self.path),
            ) from error
        if is_new:
            synchronize(self.path.parent)
        self.entries.append(line)
        self._size += len(content)


def read_log(path: Path) -> tuple[list[dict[str, Any]], int]:
    """Return the lines of a log, and the bytes that they take.

    Raises:
        DamagedCampaignError: If a line does not hold what was written.
    """
    content = path.read_bytes() if path.exists() else b""
    whole = content[: content.rfind(b"\n") + 1]
    entries, damaged = [], []
    for number, line in enumerate(whole.splitlines(), 1):
        entry = _opened(line)
        if entry is None or entry.get("line") != number:
            damaged.append(number)
        entries.append(entry or {})
    if damaged:
        raise DamagedCampaignError(
            path,
            f"line {damaged[0]} with another checksum, {len(damaged)} of "
            f"{len(entries)} lines damaged, the others whole",
        )
    return entries, len(whole)


def mend_log(path: Path) -> list[str]:
    """Give up lines that are damaged, keep a copy of the file, and return their texts.

    Args:
        path: The log; its copy ends on ".damaged".
    """
    content = path.read_bytes() if path.exists() else b""
    lines = content.splitlines(keepends=True)
    kept = [entry for line in lines if (entry := _opened(line.rstrip(b"\n")))]
    lost = [
        line.decode(errors="replace").rstrip("\n")
        for line in lines
        if _opened(line.rstrip(b"\n")) is None
    ]
    if not lost:
        return []
    path.with_suffix(".damaged").write_bytes(content)
    renumbered = [{**entry, "line": k} for k, entry in enumerate(kept, 1)]
    write_file(path, b"".join(map(_sealed, renumbered)))
    return lost


def _sealed(entry: Mapping[str, Any]) -> bytes:
    text = json.dumps(entry, allow_nan=False)
    return f'{text[:-1]}, "crc": "{zlib.crc32(text.encode()):08x}"}}\n'.encode()


def _opened(line: bytes) -> dict[str, Any] | None:
    """Return what a line holds; None where that is not what was written."""
    head, _, tail = line.rpartition(b', "crc": "')
    try:
        text = head + b"}"
        if int(tail[:8], 16) != zlib.crc32(text) or tail[8:] != b'"}':
            return None
        entry = json.loads(text)
    except (ValueError, RecursionError):
        return None
    return entry if isinstance(entry, dict) else None
