"""What was asked, told and decided, a line each, on the disk before it counts."""

from __future__ import annotations

import hashlib
import json
import os
import zlib
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from sbi_active.campaign.storage.damage import DamagedCampaignError, LogChangedError
from sbi_active.simulation.bank.damage import require_no_link
from sbi_active.simulation.bank.files import synchronize, write_file

BEGINNING = b'{"line": '  # of each line


class TrialLog:
    """A file of JSON lines that is only ever added to.

    A line ends with the CRC-32 of what is before it. A last line that was not finished,
    as its writer was killed, is no line: nothing had returned that depends on it. What
    is in the file and was neither read nor written here is never cut off: a line is
    added to what is known, or there is an error and nothing is written.

    Args:
        path: The file, made with the first line.

    Attributes:
        entries: The lines so far, without their checksums.

    Raises:
        DamagedCampaignError: If a line does not hold what was written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        require_no_link(path)
        self.entries, self._known, self._torn = read_log(path)

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
        is_new = not self._known
        size = len(self._known)
        try:
            self._require_known()
            with open(self.path, "ab", buffering=0) as file:
                if self._torn:  # by a writer that was killed
                    file.truncate(size)
                    self._torn = b""
                try:
                    rest = memoryview(content)
                    while rest:  # a disk that gets full takes a part
                        rest = rest[file.write(rest) :]
                    os.fsync(file.fileno())
                except OSError:
                    written = len(content) - len(rest)
                    if os.fstat(file.fileno()).st_size == size + written:
                        file.truncate(size)
                    raise
        except DamagedCampaignError:
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
        self._known += content

    def digest(self, lines: int) -> str:
        """Return a digest of the first lines."""
        parts = bytes(self._known).splitlines(keepends=True)[:lines]
        return hashlib.sha256(b"".join(parts)).hexdigest()

    def _require_known(self) -> None:
        """Raise where the file is not what was read and written here."""
        content = self.path.read_bytes() if self.path.exists() else b""
        if content == self._known + self._torn:
            return
        if content.startswith(self._known):
            raise LogChangedError(self.path)
        raise DamagedCampaignError(
            self.path,
            f"{len(content)} bytes other than the {len(self._known)} that were written "
            "since it was loaded; nothing was written to it now",
        )


def read_log(path: Path) -> tuple[list[dict[str, Any]], bytearray, bytes]:
    """Return the lines of a log, their bytes, and those of a line not finished.

    Raises:
        DamagedCampaignError: If a line does not hold what was written.
    """
    content = path.read_bytes() if path.exists() else b""
    whole = content[: content.rfind(b"\n") + 1]
    torn = content[len(whole) :]
    if not torn.startswith(BEGINNING[: len(torn)]):
        raise DamagedCampaignError(
            path, f"{len(torn)} bytes at its end that are no line of a log"
        )
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
    return entries, bytearray(whole), torn


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
    keep_aside(path)
    renumbered = [{**entry, "line": k} for k, entry in enumerate(kept, 1)]
    write_file(path, b"".join(map(_sealed, renumbered)))
    return lost


def keep_aside(path: Path) -> None:
    """Keep a copy of a damaged file, if any, beside those of earlier repairs."""
    if not path.exists():
        return
    number, copy = 1, path.with_suffix(".damaged")
    while copy.exists():
        number += 1
        copy = path.with_suffix(f".damaged-{number}")
    write_file(copy, path.read_bytes())


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
