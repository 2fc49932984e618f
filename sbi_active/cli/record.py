"""A campaign's trials as its folder sums them up: told and read without torch.

A command that has computed leaves a summary in the folder. What was told since is read
from the log, and :class:`Record` is all that ``tell``, ``correct``, ``withdraw`` and
``status`` need. What it cannot judge alone is :class:`Unsure`, and the campaign is
loaded.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import struct
from collections.abc import Iterator, Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from sbi_active.cli.numbers import flat
from sbi_active.cli.trusted import read_declared
from sbi_active.simulation.bank.sqlite import NAME
from sbi_active.simulation.bank.store import Store

SUMMARY = "status.json"
LOG, STATE = "log", "state"  # records of a campaign, see its storage


class Unsure(Exception):  # noqa: N818
    """Only the campaign itself can judge what is told."""


def sum_up(folder: Path, known: Mapping[str, Any]) -> None:
    """Leave a summary for the commands to come; call it while nobody else writes.

    Args:
        folder: Folder of the campaign.
        known: Facts that :class:`Record` needs.
    """
    with _stored(folder) as store:
        content = {**known, "of": _mark(store)}
    temporary = folder / f".{os.getpid()}-{SUMMARY}"
    with contextlib.suppress(OSError):  # as in a folder that is read only
        with open(temporary, "x", encoding="utf-8") as file:  # follows no link
            json.dump(content, file)
        os.replace(temporary, folder / SUMMARY)


def digest(folder: Path) -> str:
    """Return a text that changes whenever anybody writes to a campaign.

    Args:
        folder: Folder of the campaign.
    """
    with contextlib.suppress(OSError, ValueError, Unsure), _stored(folder) as store:
        return str(_mark(store))
    return ""


def _mark(store: Store, num: int | None = None) -> list[Any]:
    """Return a length of the log, and a checksum of its end and of the state."""
    num = store.length(LOG) if num is None else num
    last = store.get(LOG, num) if num else None
    content = (last or b"") + (store.get(STATE) or b"")
    return [num, hashlib.sha256(content).hexdigest()]


@contextlib.contextmanager
def _stored(folder: Path) -> Iterator[Store]:
    if not (folder / NAME).exists():
        raise Unsure
    with contextlib.closing(Store(folder, "campaign")) as store:
        yield store


class Record:
    """A campaign's record, known without computing: a part of its interface.

    Args:
        folder: Folder of the campaign.

    Attributes:
        directory: Folder of the campaign.
        x_shape: Shape of an outcome.

    Raises:
        Unsure: If there is no summary, or more was done since than told.
        ValueError: If the folder's programs are not declared as they are written.
    """

    def __init__(self, folder: Path) -> None:
        read_declared(folder)
        self.directory = folder
        try:
            self._summary = json.loads((folder / SUMMARY).read_bytes())
            self.x_shape: list[int] = self._summary["x_shape"]
            self._status = self._summary["status"]
            self._trials: list[dict[str, Any]] = self._status["trials"]
            with _stored(folder) as store:
                num = self._summary["of"][0]
                if self._summary["of"] != _mark(store, num):
                    raise Unsure
                self._num = store.length(LOG)
                for number in range(num + 1, self._num + 1):
                    self._take(json.loads(store.get(LOG, number) or b"{}"))
        except (OSError, ValueError, RecursionError, LookupError, TypeError) as error:
            raise Unsure from error

    @property
    def status(self) -> dict[str, Any]:
        """Answer of the command of this name.

        Raises:
            Unsure: If a trial that the belief has used is another one now.
        """
        if {*self._status["not_in_belief"]} & {*self._summary["processed"]}:
            raise Unsure
        return self._status

    def tell(self, x: Any, *, trial: int | None, action: Any, status: str) -> Any:
        """Record the outcome of the pending trial, or of a new one with an action."""
        pending = [t["trial"] for t in self._trials if t["status"] == "pending"]
        index = [*pending, len(self._trials)][0] if trial is None else trial
        if index == len(self._trials) and action is not None:  # that nobody asked for
            before = {"index": index, "action": None, "target": None, "reason": ""}
        elif index in pending:
            before = self._facts(index)
        else:
            raise Unsure
        return self._write("told", self._told(before, x, action, status))

    def correct(
        self, trial: int, x: Any, *, action: Any, status: str, reason: str
    ) -> Any:
        """Replace what was told of a trial."""
        before = self._facts(trial)
        told = self._told(before, x, action, status)
        # One told as before stays as it was scored.
        if before["status"] == "pending" or told == before:
            raise Unsure
        return self._write("corrected", {**told, "reason": reason})

    def withdraw(self, trial: int, *, reason: str) -> Any:
        """Take a trial out."""
        facts = {**self._facts(trial), "status": "withdrawn", "reason": reason}
        return self._write("withdrawn", facts)

    def _facts(self, index: int) -> dict[str, Any]:
        """Return a trial as the log has it."""
        if not 0 <= index < len(self._trials):
            raise Unsure
        trial = self._trials[index]
        kept = {name: trial[name] for name in ("action", "status", "target", "reason")}
        x = trial["x"] and shaped(_single(trial["x"]), self.x_shape)
        return {"index": index, **kept, "x": x}

    def _told(
        self, before: Mapping[str, Any], x: Any, action: Any, status: str
    ) -> dict[str, Any]:
        executed = before["action"]
        if action is not None:
            executed, limits = _single(action), self._summary["limits"]
            if len(limits) != len(executed) or not all(
                low <= a <= high
                for (low, high), a in zip(limits, executed, strict=True)
            ):
                raise Unsure
        if x is not None:
            x = _single(x)
        elif status == "ok":  # the action alone is corrected
            x = before.get("x")
            if x is None:
                raise Unsure
        elif status == "invalid":
            x = shaped([None] * math.prod(self.x_shape), self.x_shape)
        return {**before, "action": executed, "x": x, "status": status}

    def _write(self, event: str, facts: dict[str, Any]) -> dict[str, Any]:
        time = datetime.now(timezone.utc).isoformat(timespec="seconds")
        line = {"time": time, "event": event, "trial": facts}
        with _stored(self.directory) as store, store.writing():
            if store.append(LOG, line) != self._num + 1:  # another process was faster
                raise Unsure
        self._take(line)
        return self._trials[facts["index"]]

    def _take(self, entry: Mapping[str, Any]) -> None:
        """Take a line of the log that was written after the summary."""
        if entry["event"] not in ("told", "corrected", "withdrawn"):
            raise Unsure
        facts = dict(entry["trial"])
        index = facts.pop("index")
        if facts["x"] is not None:
            facts["x"] = [math.nan if v is None else v for v in flat(facts["x"])]
        unknown = {"information_gained": None, "surprise": None}
        told = {"trial": index, **self._summary["labels"], **unknown, **facts}
        self._trials[index : index + 1] = [told]
        waiting = {*self._status["not_in_belief"], index}
        self._status["not_in_belief"] = sorted(waiting)


def shaped(numbers: list[Any], shape: list[int]) -> Any:
    """Return numbers as nested lists of a shape."""
    if len(shape) < 2:
        return numbers if shape else numbers[0]
    size = math.prod(shape[1:])
    rows = [numbers[k : k + size] for k in range(0, len(numbers), size)]
    return [shaped(row, shape[1:]) for row in rows]


def _single(x: Any) -> Any:
    """Return numbers as float32 has them, None for one not measured."""
    if isinstance(x, list):
        return [_single(part) for part in x]
    return None if x is None or x != x else struct.unpack("f", struct.pack("f", x))[0]
