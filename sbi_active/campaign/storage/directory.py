"""The folder of a campaign: what it is, what happened, and what follows from it.

``campaign.json`` says what the campaign is and never changes. ``trials.jsonl`` is what
was asked, told and decided, and is only ever added to. From these two and the simulator
all else can be computed again: ``state.bin`` and ``belief-*.bin`` save that work, and
``simulations/`` saves the simulator's.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from sbi_active.campaign.options import CampaignOptions
from sbi_active.campaign.state import CampaignState, ModelVersion, Trial
from sbi_active.campaign.storage.codec import NotStorableError, decode, encode
from sbi_active.campaign.storage.damage import (
    DamagedCampaignError,
    LogChangedError,
    reading,
)
from sbi_active.campaign.storage.log import TrialLog, keep_aside, mend_log
from sbi_active.campaign.storage.manifest import read_manifest
from sbi_active.campaign.telling import LOST, recorded
from sbi_active.simulation.bank.files import write_file
from sbi_active.simulation.bank.lock import WriterLock

#: Names that a saved belief has; a user's own file has another.
OWN_BELIEF = re.compile(r"belief-[0-9a-f]{16}\.bin")
LOG, STATE, BELIEF, SIMULATIONS = "trials.jsonl", "state.bin", "belief", "simulations"


class CampaignDirectory:
    """Keeps a campaign on the disk.

    Any number of processes may read. The first thing that is written takes the right to
    write, which ends with :meth:`close` or the process.

    Args:
        path: Folder with a manifest.
        repair: Give up what is damaged.

    Attributes:
        path: The folder.
        manifest: What the campaign is.
        notes: What was given up, a sentence each.

    Raises:
        ValueError: If the folder holds no campaign, or one of another schema.
        DamagedCampaignError: If a file does not hold what was written.
    """

    def __init__(self, path: Path, *, repair: bool = False) -> None:
        self.path, self.notes = path, []
        self.manifest = read_manifest(path, repair=repair)
        lost = mend_log(path / LOG) if repair else []
        self.notes += [f"given up, tell it again: {text}" for text in lost]
        self._log = TrialLog(path / LOG)
        self._lock = WriterLock(path)
        self._saved = self._saved_state()
        with reading(path / STATE):
            self._require_whole(repair=repair, mended=bool(lost))
        self._belief_written: tuple[int, str | None] = (-1, None)
        self._kept: Any = None
        with reading(path / LOG):
            for entry in self._log.entries:
                if entry["event"] == "simulator changed":
                    self.manifest["simulator"] = entry["simulator"]

    def write(self, event: str, trial: Trial | None = None, **entries: Any) -> None:
        """Add to the log; it is on the disk when this returns.

        Args:
            event: What happened.
            trial: The trial as it is afterwards.
            **entries: JSON data.
        """
        self.acquire()
        facts = {} if trial is None else {"trial": _facts(trial)}
        self._log.append({"event": event, **facts, **entries})

    @property
    def events(self) -> Sequence[Mapping[str, Any]]:
        """The lines of the log so far."""
        return (*self._log.entries,)

    @property
    def simulations(self) -> Path:
        """Folder of the simulations of the current simulator."""
        changes = [e for e in self._log.entries if e["event"] == "simulator changed"]
        return self.path / (SIMULATIONS + (f"-{len(changes)}" if changes else ""))

    def save(self, state: CampaignState, belief: Any, known: Mapping[str, Any]) -> None:
        """Write what follows from the log so far.

        A belief that cannot be stored is computed again after :meth:`restore`.

        Args:
            state: Of the campaign.
            belief: After ``state.processed``; None where that is the prior.
            known: What the reader has too, see :func:`.encode`.
        """
        self.acquire()
        if belief is None:
            name = None
        elif self._belief_written[0] == id(belief):
            name = self._belief_written[1]
        else:
            try:
                content = encode(belief, known=known)
                # Another name for another belief: the state says which one is meant.
                name = f"{BELIEF}-{hashlib.sha256(content).hexdigest()[:16]}.bin"
                self._put(name, content)
            except NotStorableError:
                name = ""  # it has to be computed again
            self._kept = belief  # so that no other object gets its identity
            self._belief_written = id(belief), name
        saved = {
            "lines": len(self._log),
            "digest": self._log.digest(len(self._log)),
            "trials": state.trials,
            "processed": state.processed,
            "draws": state.draws,
            "versions": state.versions,
            "is_stale": state.is_stale,
            "batches": state.batches,
            "num_simulated": state.meter.spent,
            "belief": name,
        }
        self._put(STATE, encode(saved, known={}))
        for old in self.path.glob(f"{BELIEF}-*.bin"):
            if old.name != name and OWN_BELIEF.fullmatch(old.name):
                with suppress(OSError):
                    old.unlink()

    def restore(self, state: CampaignState) -> str | None:
        """Bring a new state to where the log ends.

        Args:
            state: Changed in place; ``is_stale`` where beliefs must be computed again.

        Returns:
            The file of the belief; None where it is the prior, or to be computed.
        """
        saved, self._saved = self._saved, None
        name, lines = None, 0
        if saved is not None:
            with reading(self.path / STATE):
                lines, name = saved["lines"], saved["belief"]
                state.trials[:] = saved["trials"]
                state.processed[:] = saved["processed"]
                state.draws |= saved.get("draws", {})  # earlier files have none
                state.versions[:] = saved["versions"]
                state.batches[:] = saved.get("batches", [])
                state.meter.spent = saved.get("num_simulated", 0)
                state.is_stale = saved["is_stale"]
        with reading(self.path / LOG):
            for entry in self._log.entries[lines:]:
                apply(state, entry)
        if name == "" and state.processed or saved is None and len(state.versions) > 1:
            state.is_stale = True
        return name or None

    def belief(self, name: str, known: Mapping[str, Any]) -> Any:
        """Return a belief from its file.

        Raises:
            ValueError: If it is damaged, another release wrote it, or it is not there
                any more.
        """
        try:
            return decode(self._get(name), known=known)
        except FileNotFoundError:
            raise ValueError(
                f"expected {name} in {self.path}; got none, as after another process "
                "went on with the campaign; load it again"
            ) from None

    def close(self) -> None:
        """Let others write."""
        self._lock.release()

    def acquire(self) -> None:
        """Take the right to write.

        Raises:
            LockedError: If another process has it.
            LogChangedError: If another process wrote since the campaign was loaded.
        """
        if self._lock.held:
            return
        self._lock.acquire()
        if TrialLog(self.path / LOG).entries != self._log.entries:
            self._lock.release()
            raise LogChangedError(self.path / LOG)

    def _saved_state(self) -> dict[str, Any] | None:
        try:
            saved = decode(self._get(STATE), known={})
        except FileNotFoundError:
            return None
        except ValueError as error:
            self.notes.append(f"{STATE} is computed again: {error}")
            return None
        return saved

    def _require_whole(self, *, repair: bool, mended: bool) -> None:
        """Raise where the log lacks lines that the saved state has counted.

        A repair takes their trials from the state, and has all else computed again.
        """
        saved = self._saved
        if saved is None:
            return
        lines, known = saved["lines"], saved.get("digest")  # earlier files have none
        if lines <= len(self._log) and known in (None, self._log.digest(lines)):
            return
        told = [t for t in saved["trials"] if t.status != "pending"]
        if not repair:
            raise DamagedCampaignError(
                self.path / LOG,
                f"{len(self._log)} lines, and not the {lines} that {STATE} has counted "
                f"with {len(told)} trials that were told",
            )
        if not mended:
            keep_aside(self.path / LOG)
        state = CampaignState("asbi", 0, CampaignOptions())
        for entry in self._log.entries:
            if "trial" in entry:
                apply(state, entry)
        lacking = [t for t in told if not _has(state, t)]
        self._saved = None
        (self.path / STATE).rename(self.path / f"{STATE}.damaged")
        for trial in lacking:
            self.write("restored", trial)
            self.notes.append(
                f"restored from {STATE}: trial {trial.index}, x = {trial.x}"
            )
        self.close()

    def _put(self, name: str, content: bytes) -> None:
        digest = hashlib.sha256(content).hexdigest()
        write_file(self.path / name, digest.encode() + b"\n" + content)

    def _get(self, name: str) -> bytes:
        digest, _, content = (self.path / name).read_bytes().partition(b"\n")
        if hashlib.sha256(content).hexdigest().encode() != digest:
            raise ValueError(f"expected {name} as written; got another checksum")
        return content


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
    """Return of a trial what cannot be computed again, NaN as null."""
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
