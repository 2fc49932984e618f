"""A campaign's trials as its folder sums them up: told and read without torch.

A command that has computed leaves a summary in the folder. While nothing else was
written since, :class:`Record` is all that ``tell``, ``correct``, ``withdraw`` and
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
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from sbi_active.campaign.storage.damage import naming
from sbi_active.cli.declared import read_declared
from sbi_active.cli.options import flat
from sbi_active.simulation.bank.sqlite import EVENTS, NAME, OBJECTS
from sbi_active.simulation.bank.store import Store

SUMMARY = "status.json"
LOG, STATE = "log", "state"  # records of a campaign, see its storage
UNSCORED = {"information_gained": None, "surprise": None}


class Unsure(Exception):  # noqa: N818
    """Only the campaign itself can judge what is told."""


def sum_up(folder: Path, known: Mapping[str, Any]) -> None:
    """Leave a summary for the commands to come; call it while nobody else writes.

    Args:
        folder: Of the campaign.
        known: What :class:`Record` needs.
    """
    content = {**known, "of": digest(folder)}
    temporary = folder / f".{os.getpid()}-{SUMMARY}"
    with contextlib.suppress(OSError):  # as in a folder that is read only
        with open(temporary, "x", encoding="utf-8") as file:  # follows no link
            json.dump(content, file)
        os.replace(temporary, folder / SUMMARY)


def digest(folder: Path) -> str:
    """Return what changes whenever anybody writes to a campaign.

    Args:
        folder: Of the campaign.
    """
    with contextlib.suppress(OSError, ValueError, Unsure), _stored(folder) as store:
        num = store.length(EVENTS, LOG)
        last = store.get(EVENTS, LOG, num) if num else None
        parts = (str(num).encode(), last or b"", store.get(OBJECTS, STATE) or b"")
        return hashlib.sha256(b"".join(parts)).hexdigest()
    return ""


@contextlib.contextmanager
def _stored(folder: Path) -> Iterator[Store]:
    if not (folder / NAME).exists():
        raise Unsure
    store = Store(folder, "campaign")
    try:
        yield store
    finally:
        store.close()


class Record:
    """What is known of a campaign without computing: a part of its interface.

    Args:
        folder: Of the campaign.

    Attributes:
        directory: As given.
        x_shape: Of an outcome.
        state: Has the trials.

    Raises:
        Unsure: If there is no summary, or it is of before.
        ValueError: If the folder's programs are not declared as they are written.
    """

    simulator = None

    def __init__(self, folder: Path) -> None:
        read_declared(folder)
        self.directory = folder
        try:
            self._summary = json.loads((folder / SUMMARY).read_bytes())
            self._require_same()
            self.x_shape: list[int] = self._summary["x_shape"]
            self.state = SimpleNamespace(trials=self._summary["status"]["trials"])
        except (OSError, ValueError, RecursionError, KeyError, TypeError) as error:
            raise Unsure from error

    @property
    def status(self) -> dict[str, Any]:
        """What the command of this name answers.

        Raises:
            Unsure: If a trial that the belief has used is another one now.
        """
        if not self._summary["is_sure"]:
            raise Unsure
        return self._summary["status"]

    def tell(self, x: Any, *, trial: int | None, action: Any, status: str) -> Any:
        """Record the outcome of the pending trial, or of a new one with an action."""
        trials = self.state.trials
        pending = [t["trial"] for t in trials if t["status"] == "pending"]
        index = [*pending, len(trials)][0] if trial is None else trial
        if index in pending:
            before = self._facts()[index]
        elif index == len(trials) and action is not None:
            before = {"index": index, "action": None, "target": None, "reason": ""}
        else:  # a trial told again, or none
            raise Unsure
        return self._write("told", self._told(before, x, action, status))

    def correct(
        self, trial: int, x: Any, *, action: Any, status: str, reason: str
    ) -> Any:
        """Replace what was told of a trial."""
        before = self._facts()[trial]
        if before["status"] == "pending":
            raise Unsure
        told = self._told(before, x, action, status)
        if told == before:  # which stays as it was scored
            raise Unsure
        return self._write("corrected", {**told, "reason": reason})

    def withdraw(self, trial: int, *, reason: str) -> Any:
        """Take a trial out."""
        before = self._facts()[trial]
        return self._write(
            "withdrawn", {**before, "status": "withdrawn", "reason": reason}
        )

    def _require_same(self) -> None:
        if not self._summary["of"] or self._summary["of"] != digest(self.directory):
            raise Unsure

    def _facts(self) -> list[dict[str, Any]]:
        """Return each trial as the log has it last."""
        with naming(), _stored(self.directory) as store:
            numbers = range(1, store.length(EVENTS, LOG) + 1)
            entries = [json.loads(store.get(EVENTS, LOG, k) or b"{}") for k in numbers]
        facts = {e["trial"]["index"]: e["trial"] for e in entries if "trial" in e}
        if [*sorted(facts)] != [*range(len(self.state.trials))]:
            raise Unsure
        return [facts[index] for index in sorted(facts)]

    def _told(
        self, before: Mapping[str, Any], x: Any, action: Any, status: str
    ) -> dict[str, Any]:
        executed = before["action"] if action is None else _single(action)
        if action is not None and not self._permits(executed):
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

    def _permits(self, action: list[float]) -> bool:
        """Return whether an action is plainly one of the campaign's."""
        space: dict[str, Any] = self._summary["actions"] or {}
        if space.get("kind") == "list":
            return action in space["values"]
        if space.get("kind") != "box" or len(action) != len(space["low"]):
            return False
        limits = zip(space["low"], action, space["high"], strict=True)
        return all(low <= a <= high for low, a, high in limits)

    def _write(self, event: str, facts: dict[str, Any]) -> dict[str, Any]:
        time = datetime.now(timezone.utc).isoformat(timespec="seconds")
        with naming(), _stored(self.directory) as store:
            with store.writing((EVENTS, LOG)) as number:
                self._require_same()
                line = {"line": number, "time": time, "event": event, "trial": facts}
                store.put(EVENTS, LOG, number, line)
            return self._noted(facts)

    def _noted(self, facts: Mapping[str, Any]) -> dict[str, Any]:
        """Return a trial as it is now, and sum up anew."""
        index, trials = facts["index"], self.state.trials
        labels = {name: self._summary[name] for name in ("names", "units")}
        told = {
            "trial": index,
            "status": facts["status"],
            "action": facts["action"],
            **labels,
            "x": None if facts["x"] is None else _numbers(facts["x"]),
            **UNSCORED,
            "reason": facts["reason"],
        }
        trials[index : index + 1] = [told]
        found = self._summary["status"]
        waiting = sorted({*found["not_in_belief"], index})
        status = {**found, "not_in_belief": waiting}
        is_sure = self._summary["is_sure"] and index not in self._summary["processed"]
        known = {**self._summary, "status": status, "is_sure": is_sure}
        sum_up(self.directory, known)
        return told


def shaped(numbers: list[Any], shape: Sequence[int]) -> Any:
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


def _numbers(x: Any) -> list[float]:
    return [math.nan if v is None else v for v in flat(x)]
