"""The folder of a campaign: what it is, what happened, and what follows from it.

All is in one file, ``store.db``. What the campaign is never changes; what was asked,
told and decided is only ever added to. From these two and the simulator all else can be
computed again: the state and the belief save that work, and the rows of simulations the
simulator's. ``campaign.toml`` says what the campaign is, for people alone.
"""

from __future__ import annotations

import functools
import json
import platform
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

from sbi_active.campaign import telling
from sbi_active.campaign.isolation import guarded, isolated
from sbi_active.campaign.learning.indexed import IndexedSimulator
from sbi_active.campaign.state import CampaignState
from sbi_active.campaign.storage.codec import NotStorableError, encode
from sbi_active.campaign.telling import LOG, STATE, SUMMARY, LogChangedError, event_of
from sbi_active.expected import require
from sbi_active.simulation.bank.bank import Bank
from sbi_active.simulation.bank.store import NAME, Store
from sbi_active.simulation.fingerprint import fingerprint
from sbi_active.simulation.model import SimulatorModel
from sbi_active.simulation.workers.store import metering

FORMAT, SCHEMA = "sbi-active campaign", 3  # schema 1 was a folder of files
MANIFEST, BELIEF, FOR_PEOPLE = "campaign", "belief", "campaign.toml"
OWN = "drawn"  # rows of the simulator itself
PACKAGES = "sbi-active", "sbi", "torch", "numpy"
#: What a state holds beside the settings of the campaign.
SAVED = ("trials", "processed", "draws", "versions", "is_stale", "batches")
Method = TypeVar("Method", bound=Callable[..., Any])


class Storage:
    """Keeps a campaign in a folder, its simulations in banks, or neither.

    Any number of processes may read. The first thing that is written takes the right to
    write, which ends with :meth:`close` or the process. A row is never simulated twice:
    what is asked for again, by the same seed, theta and action, is read. Rows of
    rivals, simulators with effects that are compared and not used, are not stored.

    Args:
        path: Folder with a campaign; None keeps it in memory alone.
        prior: Prior that the campaign began with; it may be set later.

    Attributes:
        path: The folder.
        manifest: Description of the campaign.
        bank: Folder of the simulations, to be set; None keeps them in the campaign's
            file.
        prior: Prior that the campaign began with.

    Raises:
        ValueError: If the folder holds no campaign, or one of another schema.
        CorruptSegmentError: If the file does not hold what was written.
    """

    def __init__(self, path: Path | None = None, *, prior: Any = None) -> None:
        self.path, self.prior = path, prior
        self.manifest: dict[str, Any] = {}
        self.events: list[dict[str, Any]] = []
        self.bank: str | None = None
        self._written: Any = None  # the belief that is on the disk
        self._banks: dict[str, Bank] = {}
        self._shared: Any = None  # the file of ``bank``
        self.store: Any = None
        if path is not None:
            self.store = Store(path, "campaign")
            with self.store.reading():
                self.manifest = self.store.json(MANIFEST) or {}
                for number in range(1, self.store.length(LOG) + 1):
                    self.events.append({**self.store.json(LOG, number), "line": number})
                    _ = self.events[-1]["event"]
            form, packages = map(self.manifest.get, ("schema", "packages"))
            expected, got = f"a campaign of schema {SCHEMA}", f"{form} in {path}"
            advice = f"use the release that wrote it, {packages}, or make a campaign"
            require(form == SCHEMA, expected, got, advice)

    def find_bank(self, name: str, simulator: Any, version: int) -> Bank | None:
        """Return the bank of a form of the current simulator, open for writing.

        Args:
            name: Name of the form; "" for another simulator, which has no bank.
            simulator: Simulator whose rows are to be kept.
            version: Number of the current simulator.
        """
        if not name or self.store is None and self.bank is None:
            return None
        changes = 0 if self.bank is not None else len(self.changes)
        name += f"-model-{version}" * (version > 0)
        name += f"-changed-{changes}" * (changes > 0)
        if name not in self._banks:
            if self.bank is not None and self._shared is None:
                self._shared = Store(Path(self.bank), make=True)
            place: Any = self._shared or self.store
            self._banks[name] = Bank(place, simulator=simulator, name=name)
        return self._banks[name]

    @property
    def changes(self) -> list[Any]:
        """Fingerprints of the simulators that took the place of the one before."""
        found = [event for event in self.events if "simulator" in event]
        return [event["simulator"] for event in found]

    def write(self, event: str, trial: Any = None, **entries: Any) -> None:
        """Add to the log; it is on the disk when this returns.

        Args:
            event: Event that is written.
            trial: The trial as it is afterwards, or its facts.
            **entries: JSON data.
        """
        if self.store is not None:
            line = json.dumps(event_of(event, trial, **entries), allow_nan=False)
            with self._writing():
                number = self.store.append(LOG, line.encode())
            self.events.append({**json.loads(line), "line": number})

    def save(self, state: CampaignState, learner: Any) -> None:
        """Write what follows from the log so far.

        A belief that cannot be stored is computed again by who loads the campaign.

        Args:
            state: State of the campaign.
            learner: Learner of the campaign, whose belief is after ``state.processed``.
        """
        if self.store is None:
            return
        belief = None if learner.belief is learner.prior else learner.belief
        saved = {name: getattr(state, name) for name in SAVED}
        saved |= {"lines": len(self.events), "num_simulated": state.meter.spent}
        saved["belief"] = belief is not None
        contents = {STATE: encode(saved, known={}), SUMMARY: b"{}"}
        if belief is not self._written:
            known, contents[BELIEF] = {"simulator": learner.simulator}, b""
            with suppress(NotStorableError):
                contents[BELIEF] = encode(belief, known={**known, "prior": self.prior})
        with self._writing():
            for kind, content in contents.items():
                self.store.put(kind, 0, content)
        self._written = belief

    def sum_up(self, known: Mapping[str, Any]) -> None:
        """Leave what a reader without torch needs, as far as the log goes now.

        Args:
            known: Facts, as JSON data with NaN.
        """
        content = json.dumps({"lines": len(self.events), **known}).encode()
        with self._writing():
            self.store.put(SUMMARY, 0, content)

    def close(self) -> None:
        """Let others write."""
        for store in filter(None, (self._shared, self.store)):
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
        with self.store.writing():
            same = self.store.length(LOG) == len(self.events)
            if same:
                yield
        if not same:
            self.store.close()
            raise LogChangedError(self.path)


def make_campaign(
    folder: Path, state: Any, given: Mapping[str, Any], simulator: Any, **facts: Any
) -> None:
    """Write what a new campaign is.

    Args:
        folder: Folder, which is made where there is none.
        state: State of the campaign.
        given: Prior, actions and options.
        simulator: Simulator of the campaign.
        **facts: Facts to note, as JSON data.

    Raises:
        ValueError: If the folder holds anything.
        OSError: If it cannot be written.
    """
    packages = {name: version(name) for name in PACKAGES}
    packages["python"] = platform.python_version()
    manifest = {"method": state.method, "seed": state.seed}
    manifest |= {"created": telling.now(), "packages": packages}
    manifest["simulator"] = fingerprint(simulator)
    for name in ("parameter_names", "channel_names"):
        found = getattr(simulator, name, None)
        manifest[name] = found if found is None else [*found]
    objects = {}
    for what, thing in given.items():
        manifest[f"{what}_text"] = repr(thing)
        manifest[f"{what}_settings"] = fingerprint(thing, version="settings")
        with suppress(NotStorableError):
            objects[what] = encode(thing, known={})
    write_campaign(folder, manifest | facts, objects)


def write_campaign(
    folder: Path, manifest: Mapping[str, Any], objects: Mapping[str, bytes]
) -> None:
    """Write a manifest, the objects beside it, and a text for people.

    Raises:
        ValueError: If the folder holds anything.
        OSError: If it cannot be written.
    """
    store = Store(folder, "campaign", make=True)
    expected, got = "an empty folder for a new campaign", f"{folder} with one"
    advice = "go on by Campaign.load(directory, simulator=...) or choose another folder"
    require(not store.catalog, expected, got, advice)
    with store.writing():
        store.put(MANIFEST, 0, {**manifest, "format": FORMAT, "schema": SCHEMA})
        for kind, content in objects.items():
            store.put(kind, 0, content)
    store.close()
    lines = [f"# What this campaign is, for people. {NAME} has all; this is not read."]
    for key, value in manifest.items():  # a text of JSON is one of TOML
        is_read = isinstance(value, str | int | list)
        if is_read and key != "own":
            lines.append(f"{key.removesuffix('_text')} = {json.dumps(value)}")
    (folder / FOR_PEOPLE).write_text("\n".join([*lines, ""]), encoding="utf-8")


def stored(method: Method) -> Method:
    """Return a method that simulates: its rows are kept, apart from global state.

    See :func:`.isolated`.
    """
    apart = isolated(method)

    @guarded
    @functools.wraps(method)
    def kept(campaign: Any, *arguments: Any, **options: Any) -> Any:
        storage, own = campaign._storage, campaign._learner.simulator
        version = campaign.state.version.number
        expected = "the simulator, which is not stored with a campaign"
        advice = "pass it: Campaign.load(directory, simulator=...)"
        require(own is not None, expected, "none", advice)
        storage.acquire()

        def find(simulator: Any) -> Bank | None:
            return storage.find_bank(form_of(simulator, own), simulator, version)

        with metering(campaign.state.meter, find):
            return apart(campaign, *arguments, **options)

    return kept  # type: ignore[return-value]


def form_of(simulator: Any, own: Any) -> str:
    """Return the name of a form of the current simulator; "" for another one.

    Args:
        simulator: Simulator that may be such a form.
        own: The current simulator.
    """
    if simulator is own:
        return OWN
    if isinstance(simulator, IndexedSimulator):
        return "by-index" * (simulator.simulator is own)
    if not (isinstance(simulator, SimulatorModel) and isinstance(own, SimulatorModel)):
        return ""
    parts = [(m.fn, *getattr(m, "effects", ())) for m in (simulator, own)]
    if [*map(id, parts[0])] != [*map(id, parts[1])]:
        return ""
    if simulator.noise is None and own.noise is not None:
        return "noise-free"
    index = getattr(simulator, "next_index", None)
    return "" if index is None else f"drawn-trial-{index}"
