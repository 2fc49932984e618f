"""The folder of a campaign: what it is, what happened, and what follows from it.

``campaign.json`` says what the campaign is and never changes. ``trials.jsonl`` is what
was asked, told and decided, and is only ever added to. From these two and the simulator
all else can be computed again: ``state.bin`` and ``belief-*.bin`` save that work, and
``simulations/`` saves the simulator's.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from sbi_active.campaign.state import CampaignState, ModelVersion, Trial
from sbi_active.campaign.storage.codec import NotStorableError, decode, encode
from sbi_active.campaign.storage.log import TrialLog, mend_log
from sbi_active.campaign.storage.manifest import read_manifest
from sbi_active.campaign.telling import recorded
from sbi_active.simulation.bank.lock import WriterLock
from sbi_active.simulation.bank.segments import write_file

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
        if repair and (lost := mend_log(path / LOG)):
            (path / STATE).unlink(missing_ok=True)  # it counts other lines
            self.notes = [f"given up, tell it again: {text}" for text in lost]
        self._log = TrialLog(path / LOG)
        self._lock = WriterLock(path)
        self._belief_written: tuple[int, str | None] = (-1, None)
        self._kept: Any = None
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
            if old.name != name:
                with suppress(OSError):
                    old.unlink()

    def restore(self, state: CampaignState) -> str | None:
        """Bring a new state to where the log ends.

        Args:
            state: Changed in place; ``is_stale`` where beliefs must be computed again.

        Returns:
            The file of the belief; None where it is the prior, or to be computed.
        """
        saved = self._saved_state()
        name, lines = None, 0
        if saved is not None:
            lines, name = saved["lines"], saved["belief"]
            state.trials[:] = saved["trials"]
            state.processed[:] = saved["processed"]
            state.draws |= saved.get("draws", {})  # earlier files have none
            state.versions[:] = saved["versions"]
            state.batches[:] = saved.get("batches", [])
            state.meter.spent = saved.get("num_simulated", 0)
            state.is_stale = saved["is_stale"]
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
            ValueError: If another process wrote since the campaign was loaded.
        """
        if self._lock.held:
            return
        self._lock.acquire()
        if len(TrialLog(self.path / LOG)) != len(self._log):
            self._lock.release()
            raise ValueError(
                f"expected the campaign in {self.path} as it was loaded; got trials "
                "that another process told since; load it again"
            )

    def _saved_state(self) -> dict[str, Any] | None:
        try:
            saved = decode(self._get(STATE), known={})
        except FileNotFoundError:
            return None
        except ValueError as error:
            self.notes.append(f"{STATE} is computed again: {error}")
            return None
        if saved["lines"] > len(self._log):
            self.notes.append(f"{STATE} is computed again: it is of another log")
            return None
        return saved

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
