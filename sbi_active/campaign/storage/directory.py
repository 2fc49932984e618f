"""The folder of a campaign: what it is, what happened, and what follows from it.

All is in one file, ``store.db``. What the campaign is never changes; what was asked,
told and decided is only ever added to. From these two and the simulator all else can be
computed again: the state and the belief save that work, and the rows of simulations the
simulator's. ``campaign.toml`` says what the campaign is, for people alone.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import torch

from sbi_active.campaign.options import CampaignOptions
from sbi_active.campaign.state import CampaignState, ModelVersion, Trial
from sbi_active.campaign.storage.codec import NotStorableError, decode, encode
from sbi_active.campaign.storage.damage import (
    DamagedCampaignError,
    LogChangedError,
    naming,
    reading,
)
from sbi_active.campaign.storage.manifest import read_manifest
from sbi_active.campaign.telling import LOST, recorded
from sbi_active.simulation.bank.damage import CorruptSegmentError, parsed, require
from sbi_active.simulation.bank.sqlite import EVENTS, OBJECTS
from sbi_active.simulation.bank.store import Store

LOG, STATE, BELIEF = "log", "state", "belief"


class CampaignDirectory:
    """Keeps a campaign on the disk.

    Any number of processes may read. The first thing that is written takes the right to
    write, which ends with :meth:`close` or the process.

    Args:
        path: Folder with a campaign.
        repair: Whether to give up what is damaged.

    Attributes:
        path: The folder.
        store: Store of the campaign's records.
        manifest: Description of the campaign.
        notes: Notes on what was given up, a sentence each.

    Raises:
        ValueError: If the folder holds no campaign, or one of another schema.
        DamagedCampaignError: If the file does not hold what was written.
    """

    def __init__(self, path: Path, *, repair: bool = False) -> None:
        self.path = path
        self.notes: list[str] = []
        with naming():
            self.store = Store(path, "campaign")
            if repair and self.store.problems():
                self.store.salvage()
            self._entries, lost = self._lines()
        if lost and not repair:
            total = len(self._entries) + len(lost)
            reason = (
                f"{lost[0]}, {len(lost)} of {total} lines damaged, the others whole"
            )
            raise DamagedCampaignError(self.store.path, reason)
        if lost:
            self._mend()
        self.manifest = read_manifest(self.store, repair=repair)
        self._saved = self._saved_state()
        with reading(self.store.path):
            self._require_whole(repair=repair)
        self._belief_written: tuple[int, str | None] = (-1, None)
        self._kept: Any = None
        for entry in self._changes:
            self.manifest["simulator"] = entry["simulator"]

    def write(self, event: str, trial: Trial | None = None, **entries: Any) -> None:
        """Add to the log; it is on the disk when this returns.

        Args:
            event: Event that is written.
            trial: The trial as it is afterwards.
            **entries: JSON data.
        """
        facts = {} if trial is None else {"trial": _facts(trial)}
        time = datetime.now(timezone.utc).isoformat(timespec="seconds")
        line = {"line": len(self._entries) + 1, "time": time, "event": event}
        self.acquire()
        with naming(), self.store.writing((EVENTS, LOG)) as number:
            if number != line["line"]:
                raise LogChangedError(self.store.path)
            self.store.put(EVENTS, LOG, number, {**line, **facts, **entries})
        self._entries.append({**line, **facts, **entries})

    @property
    def events(self) -> Sequence[Mapping[str, Any]]:
        """The lines of the log so far."""
        return (*self._entries,)

    @property
    def num_changes(self) -> int:
        """Number of times that another simulator took the place of the one before."""
        return len(self._changes)

    def save(self, state: CampaignState, belief: Any, known: Mapping[str, Any]) -> None:
        """Write what follows from the log so far.

        A belief that cannot be stored is computed again after :meth:`restore`.

        Args:
            state: State of the campaign.
            belief: Belief after ``state.processed``; None if that is the prior.
            known: Objects that the reader has too, see :func:`.encode`.
        """
        content = None
        name = self._belief_written[1] if belief is not None else None
        if belief is not None and self._belief_written[0] != id(belief):
            try:
                content = encode(belief, known=known)
                name = hashlib.sha256(content).hexdigest()
            except NotStorableError:
                name = ""  # it has to be computed again
        saved = {
            "lines": len(self._entries),
            "trials": state.trials,
            "processed": state.processed,
            "draws": state.draws,
            "versions": state.versions,
            "is_stale": state.is_stale,
            "batches": state.batches,
            "num_simulated": state.meter.spent,
            "belief": name,
        }
        encoded = encode(saved, known={})
        self.acquire()
        with naming(), self.store.writing():
            if self.store.length(EVENTS, LOG) != len(self._entries):
                raise LogChangedError(self.store.path)
            self.store.put(OBJECTS, STATE, 0, encoded)
            if content is not None:
                self.store.put(OBJECTS, BELIEF, 0, content)
        if belief is not None:
            self._kept = belief  # so that no other object gets its identity
            self._belief_written = id(belief), name

    def restore(self, state: CampaignState) -> str | None:
        """Bring a new state to where the log ends.

        Args:
            state: State that is changed in place; ``is_stale`` where beliefs must be
                computed again.

        Returns:
            The name of the belief; None if it is the prior, or to be computed.
        """
        saved, self._saved = self._saved, None
        name, lines = None, 0
        with reading(self.store.path):
            if saved is not None:
                lines, name = saved["lines"], saved["belief"]
                state.trials[:] = saved["trials"]
                state.processed[:] = saved["processed"]
                state.draws |= saved["draws"]
                state.versions[:] = saved["versions"]
                state.batches[:] = saved["batches"]
                state.meter.spent = saved["num_simulated"]
                state.is_stale = saved["is_stale"]
            for entry in self._entries[lines:]:
                apply(state, entry)
        if name == "" and state.processed or saved is None and len(state.versions) > 1:
            state.is_stale = True
        return name or None

    def belief(self, name: str, known: Mapping[str, Any]) -> Any:
        """Return a belief by its name.

        Raises:
            ValueError: If it is damaged, another release wrote it, or it is not there
                any more.
        """
        content = b""
        with suppress(CorruptSegmentError):
            content = self.store.get(OBJECTS, BELIEF) or content
        if hashlib.sha256(content).hexdigest() != name:
            raise ValueError(
                f"expected the belief {name:.8} in {self.store.path}; got another or a "
                "damaged one, as after another process went on with the campaign; load "
                "it again"
            )
        return decode(content, known=known)

    def close(self) -> None:
        """Let others write."""
        self.store.close()

    def acquire(self) -> None:
        """Take the right to write.

        Raises:
            LockedError: If another process has it.
            LogChangedError: If another process wrote since the campaign was loaded.
        """
        if self.store.held:
            return
        with naming():
            self.store.acquire()
            last = len(self._entries)
            try:
                if self.store.length(EVENTS, LOG) != last or (
                    last and self._line(last) != self._entries[-1]
                ):
                    raise LogChangedError(self.store.path)
            except BaseException:
                self.store.close()
                raise

    @property
    def _changes(self) -> list[dict[str, Any]]:
        return [e for e in self._entries if e["event"] == "simulator changed"]

    def _line(self, number: int) -> dict[str, Any]:
        content = self.store.get(EVENTS, LOG, number)
        line = parsed(self.store.path, content or b"")
        is_own = line.get("line") == number and type(line.get("event")) is str
        require(self.store.path, is_own, f"a line {number} of the log that none writes")
        return line

    def _lines(self) -> tuple[list[dict[str, Any]], list[str]]:
        """Return the lines of the log that are whole, and what is left of others."""
        whole, lost = [], []
        for number in range(1, self.store.length(EVENTS, LOG) + 1):
            try:
                whole.append(self._line(number))
            except CorruptSegmentError as error:
                left = self.store.remains(EVENTS, LOG, number)
                lost.append(error.reason)
                self.notes.append(
                    f"SA603 given up, tell it again: {left or error.reason}"
                )
        return whole, lost

    def _mend(self) -> None:
        """Give up lines that are damaged, and keep a copy of the file."""
        with naming():
            self.store.salvage()
            with self.store.writing():
                for number, line in enumerate(self._entries, 1):
                    line["line"] = number
                    self.store.put(EVENTS, LOG, number, line)
                num = len(self._entries)
                self.store.delete(EVENTS, LOG, first=num + 1)
                self.store.put(OBJECTS, f"{EVENTS} of {LOG}", 0, {"length": num})
        self.store.close()

    def _saved_state(self) -> dict[str, Any] | None:
        try:
            content = self.store.get(OBJECTS, STATE)
            return None if content is None else decode(content, known={})
        except (CorruptSegmentError, ValueError) as error:
            self.notes.append(f"SA601 {STATE} is computed again: {error}")
            return None

    def _require_whole(self, *, repair: bool) -> None:
        """Raise if the log lacks lines that the saved state has counted.

        A repair takes their trials from the state, and has all else computed again.
        """
        saved = self._saved
        mended = any(note.startswith("SA603") for note in self.notes)
        if saved is None or saved["lines"] <= len(self._entries) and not mended:
            return
        told = [t for t in saved["trials"] if t.status != "pending"]
        if not repair:
            raise DamagedCampaignError(
                self.store.path,
                f"{len(self._entries)} lines of the log, and not the {saved['lines']} "
                f"that the state has counted with {len(told)} trials that were told",
            )
        state = CampaignState("asbi", 0, CampaignOptions())
        for entry in self._entries:
            if "trial" in entry:
                apply(state, entry)
        self._saved = None
        with self.store.writing():
            self.store.delete(OBJECTS, STATE)
        for trial in [t for t in told if not _has(state, t)]:
            self.write("restored", trial)
            self.notes.append(
                f"SA603 restored from {STATE}: trial {trial.index}, x = {trial.x}"
            )
        self.close()


def apply(state: CampaignState, entry: Mapping[str, Any]) -> None:
    """Change a state by a line of the log, as the campaign did when it was written."""
    event = entry["event"]
    if "trial" in entry:
        state.record(_trial(state, entry["trial"]))
    elif event == "simulator changed":
        state.is_stale = bool(state.processed)  # until an update is saved
    elif event == "examined":
        state.examined(entry["digest"])
    elif event == "adopted":
        version = {k: _tupled(v) for k, v in entry["version"].items()}
        state.versions.append(ModelVersion(**version))
        state.processed[:] = version["trials"]
        state.is_stale = True


def _has(state: CampaignState, trial: Trial) -> bool:
    """Return whether a state has a trial that was told, as it was told or since."""
    if trial.index >= len(state.trials):
        return False
    return state.trials[trial.index].reason != LOST and (
        state.trials[trial.index].status != "pending"
    )


def _facts(trial: Trial) -> dict[str, Any]:
    """Return the facts of a trial that cannot be computed again, NaN as null."""
    x = None if trial.x is None else _listed(trial.x.tolist())
    return {
        "index": trial.index,
        "action": trial.action.tolist(),
        "x": x,
        "status": trial.status,
        "target": trial.target,
        "reason": trial.reason,
    }


def _listed(x: Any) -> Any:
    if isinstance(x, list):
        return [_listed(part) for part in x]
    return x if x == x else None


def _trial(state: CampaignState, facts: Mapping[str, Any]) -> Trial:
    action = torch.tensor(facts["action"], dtype=torch.float32)
    x = facts["x"]
    if x is not None:
        x = torch.tensor(_numbers(x), dtype=torch.float32)
    return recorded(state, {**facts, "action": action, "x": x})


def _numbers(x: Any) -> Any:
    if isinstance(x, list):
        return [_numbers(part) for part in x]
    return float("nan") if x is None else x


def _tupled(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
