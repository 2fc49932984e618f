"""The folder of a campaign: what it is, what happened, and what follows from it.

All is in one file, ``store.db``. What the campaign is never changes; what was asked,
told and decided is only ever added to. From these two and the simulator all else can be
computed again: the state and the belief save that work, and the rows of simulations the
simulator's. ``campaign.toml`` says what the campaign is, for people alone.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sbi_active.campaign.state import CampaignState, ModelVersion
from sbi_active.campaign.storage.codec import NotStorableError, decode, encode
from sbi_active.campaign.storage.simulations import form_of
from sbi_active.campaign.telling import LOG, STATE, SUMMARY, event_of, facts_in
from sbi_active.messages import Explained
from sbi_active.simulation.bank.bank import Bank
from sbi_active.simulation.bank.sqlite import (
    NAME,
    CorruptSegmentError,
    require,
    sensible,
)
from sbi_active.simulation.bank.store import Store

FORMAT, SCHEMA = "sbi-active campaign", 3  # schema 1 was a folder of files
#: Records: what a campaign is, with a copy, and what was computed.
MANIFEST, COPY, BELIEF = "campaign", "campaign copy", "belief"
#: What a state holds beside the settings of the campaign.
SAVED = ("trials", "processed", "draws", "versions", "is_stale", "batches")


class LogChangedError(Explained, ValueError):
    """Another writer added to a campaign since it was loaded here.

    Attributes:
        path: The file.
    """

    code = "SA607"

    def __init__(self, path: Path) -> None:
        self.path = path
        super().__init__(
            f"expected the campaign in {path.parent} as it was loaded; got trials that "
            "another process told since; load it again, and tell this once more: "
            "nothing was written"
        )


class Storage:
    """Keeps a campaign in a folder, its simulations in banks, or neither.

    Any number of processes may read. The first thing that is written takes the right to
    write, which ends with :meth:`close` or the process. A row is never simulated twice:
    what is asked for again, by the same seed, theta and action, is read. Rows of
    rivals, simulators with effects that are compared and not used, are not stored.

    Args:
        path: Folder with a campaign; None keeps it in memory alone.
        repair: Whether to give up what is damaged.
        prior: Prior that the campaign began with; it may be set later.

    Attributes:
        path: The folder.
        store: Store of the campaign's records; None without a folder.
        manifest: Description of the campaign.
        notes: Notes on what was given up, a sentence each.
        bank: Folder of the simulations, to be set; None keeps them in the campaign's
            file.
        prior: Prior that the campaign began with.

    Raises:
        ValueError: If the folder holds no campaign, or one of another schema.
        CorruptSegmentError: If the file does not hold what was written.
    """

    def __init__(
        self, path: Path | None = None, *, repair: bool = False, prior: Any = None
    ) -> None:
        self.path, self.prior = path, prior
        self.notes: list[str] = []
        self.manifest: dict[str, Any] = {}
        self.bank: str | None = None
        self._entries: list[dict[str, Any]] = []
        self._saved: dict[str, Any] | None = None
        self._written: Any = None  # the belief that is on the disk
        self._banks: dict[str, Bank] = {}
        self._shared: Store | None = None  # the file of ``bank``
        self.store: Any = None
        if path is not None:
            self.store = Store(path, "campaign")
            if repair and self.store.problems():
                self._give_up()
            with self.store.reading():
                self._read(repair=repair)

    def _read(self, *, repair: bool) -> None:
        store = self.store
        self.manifest = read_manifest(store)
        self._entries = [self._line(k + 1) for k in range(store.length(LOG))]
        self._saved = self._kept(STATE, lambda content: decode(content, known={}))
        if self._saved is not None:
            with sensible(store.path):
                self._require_whole(self._saved, repair=repair)
        for entry in self._changes:
            self.manifest["simulator"] = entry["simulator"]

    def find_bank(
        self, simulator: Callable[..., Any], current: Any, version: int
    ) -> Bank | None:
        """Return the bank of a form of the current simulator, open for writing.

        Args:
            simulator: Simulator whose rows are to be kept.
            current: The current simulator of the campaign.
            version: Number of its version.
        """
        is_kept = self.store is not None or self.bank is not None
        name = form_of(simulator, current) if is_kept and current is not None else None
        if name is None:
            return None
        changes = len(self._changes) if self.bank is None else 0
        name += f"-model-{version}" * (version > 0)
        name += f"-changed-{changes}" * (changes > 0)
        if name not in self._banks:
            if self.bank is not None and self._shared is None:
                self._shared = Store(Path(self.bank), make=True)
            place: Any = self._shared or self.store
            self._banks[name] = Bank(place, simulator=simulator, name=name)
        return self._banks[name]

    def write(self, event: str, trial: Any = None, **entries: Any) -> None:
        """Add to the log; it is on the disk when this returns.

        Args:
            event: Event that is written.
            trial: The trial as it is afterwards, or its facts.
            **entries: JSON data.
        """
        if self.store is None:
            return
        line = json.loads(json.dumps(event_of(event, trial, **entries)))
        with self._writing():
            number = self.store.append(LOG, line)
        self._entries.append({**line, "line": number})  # as it is read again

    @property
    def events(self) -> Sequence[Mapping[str, Any]]:
        """The lines of the log so far."""
        return (*self._entries,)

    def given(self, what: str, *, reads: bool) -> Any:
        """Return the prior, the actions or the options; None if they are not stored.

        Args:
            what: Name of one of these.
            reads: Whether draws that stand for it do.

        Raises:
            CorruptSegmentError: If they are not what was written.
        """
        content = self.store.get(what)
        with sensible(self.store.path):
            if content is None or what in self.manifest["own"] and not reads:
                return None
            return decode(content, known={})

    def save(self, state: CampaignState, learner: Any) -> None:
        """Write what follows from the log so far.

        A belief that cannot be stored is computed again after :meth:`restore`.

        Args:
            state: State of the campaign.
            learner: Learner of the campaign, whose belief is after ``state.processed``.
        """
        if self.store is None:
            return
        belief = None if learner.belief is learner.prior else learner.belief
        saved = {
            "lines": len(self._entries),
            **{name: getattr(state, name) for name in SAVED},
            "num_simulated": state.meter.spent,
            "belief": belief is not None,
        }
        contents = {STATE: encode(saved, known={})}
        if belief is not None and belief is not self._written:
            contents[BELIEF] = b""  # computed again, unless it can be stored
            with suppress(NotStorableError):
                known = {"simulator": learner.simulator, "prior": self.prior}
                contents[BELIEF] = encode(belief, known=known)
        with self._writing():
            self.store.delete(SUMMARY)  # which is of the state before
            for kind, content in contents.items():
                self.store.put(kind, 0, content)
        self._written = belief

    def sum_up(self, known: Mapping[str, Any]) -> None:
        """Leave what a reader without torch needs, as far as the log goes now.

        Args:
            known: Facts, as JSON data with NaN.
        """
        content = json.dumps({"lines": len(self._entries), **known}).encode()
        with self._writing():
            self.store.put(SUMMARY, 0, content)

    def restore(self, state: CampaignState) -> bytes | None:
        """Bring a new state to where the log ends.

        Args:
            state: State that is changed in place; ``is_stale`` where beliefs must be
                computed again.

        Returns:
            The belief, encoded; None if it is the prior, or to be computed.
        """
        saved, self._saved = self._saved or {}, None
        with sensible(self.store.path):
            for name in SAVED if saved else ():
                setattr(state, name, saved[name])
            state.meter.spent = saved.get("num_simulated", 0)
            for entry in self._entries[saved.get("lines", 0) :]:
                apply(state, entry)
        if not saved:
            state.is_stale |= len(state.versions) > 1
        if saved.get("belief") in (None, False):
            return None
        belief = self._kept(BELIEF, bytes)
        state.is_stale |= not belief and bool(state.processed)
        return belief or None

    def close(self) -> None:
        """Let others write."""
        for store in (self._shared, self.store):
            if store is not None:
                store.close()
        self._banks.clear()

    def acquire(self) -> None:
        """Take the right to write.

        Raises:
            LockedError: If another process has it.
            LogChangedError: If another process wrote since the campaign was loaded.
        """
        if self.store is not None and not self.store.held:
            with self._writing():
                pass

    @contextmanager
    def _writing(self) -> Iterator[None]:
        num, is_known = len(self._entries), self.store.held
        with self.store.writing():
            same = self.store.length(LOG) == num
            if same and num and not is_known:  # others may have written since
                same = self._line(num) == self._entries[-1]
            if same:
                yield
                return
        self.store.close()
        raise LogChangedError(self.store.path)

    @property
    def _changes(self) -> list[dict[str, Any]]:
        return [e for e in self._entries if e["event"] == "simulator changed"]

    def _line(self, number: int) -> dict[str, Any]:
        line = {**(self.store.json(LOG, number) or {}), "line": number}
        is_own = isinstance(line.get("event"), str)
        require(self.store.path, is_own, f"a line {number} of the log that none writes")
        return line

    def _give_up(self) -> None:
        """Give up damaged records, and note what is left of lines of the log."""
        store = self.store
        with suppress(CorruptSegmentError):  # how many there were
            for number in range(1, store.length(LOG) + 1):
                try:
                    self._line(number)
                except CorruptSegmentError as error:
                    left = store.remains(LOG, number) or error.reason
                    self.notes.append(f"SA603 given up, tell it again: {left}")
        store.salvage()
        with store.writing():
            store.delete(SUMMARY)
        store.close()

    def _kept(self, what: str, read: Callable[[bytes], Any]) -> Any:
        """Return what was computed; None where it has to be computed again."""
        try:
            content = self.store.get(what)
            return None if content is None else read(content)
        except (CorruptSegmentError, ValueError) as error:
            self.notes.append(f"SA601 the {what} is computed again: {error}")
            return None

    def _require_whole(self, saved: Mapping[str, Any], *, repair: bool) -> None:
        """Raise if the log lacks lines that the saved state has counted.

        A repair takes their trials from the state, and has all else computed again.
        """
        given_up = any(note.startswith("SA603") for note in self.notes)
        if saved["lines"] <= len(self._entries) and not given_up:
            return
        told = [t for t in saved["trials"] if t.status != "pending"]
        reason = f"{len(self._entries)} lines of the log; the state counts"
        reason = f"{reason} {saved['lines']} with {len(told)} trials that were told"
        require(self.store.path, repair, reason)
        facts = filter(None, map(facts_in, self._entries))
        last = {f.index: f.status for f in facts}
        self._saved = None
        with self.store.writing():
            self.store.delete(STATE)
        for trial in told:
            if last.get(trial.index, "pending") == "pending":
                self.write("restored", trial)
                self.notes.append(
                    f"SA603 restored from {STATE}: trial {trial.index}, x = {trial.x}"
                )
        self.close()


def has_manifest(folder: Path) -> bool:
    """Return whether a folder holds a campaign, damaged or of before or not."""
    if not (folder / NAME).exists():
        return (folder / "campaign.json").exists()
    try:
        return MANIFEST in Store(folder, "campaign").catalog
    except OSError:
        return True


def read_manifest(store: Store) -> dict[str, Any]:
    """Return what a campaign is; from the copy where a repair gave up the first.

    Raises:
        ValueError: If there is none, or one of another schema.
        CorruptSegmentError: If it does not hold what was written.
    """
    manifest = store.json(MANIFEST) or store.json(COPY)
    if manifest is None:
        raise ValueError(
            f"expected a folder with a campaign; got {store.folder} without one; make "
            "it by Campaign(..., directory=...)"
        )
    if (manifest.get("format"), manifest.get("schema")) != (FORMAT, SCHEMA):
        with sensible(store.path):
            release = manifest["packages"]["sbi-active"]
        raise ValueError(
            f"expected a campaign of schema {SCHEMA}; got {manifest.get('schema')} in "
            f"{store.path}; use the release of sbi-active that wrote it: {release}"
        )
    return manifest


def apply(state: CampaignState, entry: Mapping[str, Any]) -> None:
    """Change a state by a line of the log, as the campaign did when it was written."""
    event, facts = entry["event"], facts_in(entry)
    if facts is not None:
        state.record(facts)
    elif event == "simulator changed":
        state.is_stale = bool(state.processed)  # until an update is saved
    elif event == "examined":
        state.examined(entry["digest"])
    elif event == "adopted":
        version: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in entry["version"].items()
        }
        state.versions.append(ModelVersion(**version))
        state.processed[:] = version["trials"]
        state.is_stale = True
