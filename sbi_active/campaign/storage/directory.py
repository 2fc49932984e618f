"""The folder of a campaign: what it is, what happened, and what follows from it.

All is in one file, ``store.db``. What the campaign is never changes; what was asked,
told and decided is only ever added to. From these two and the simulator all else can be
computed again: the state and the belief save that work, and the rows of simulations the
simulator's. ``campaign.toml`` says what the campaign is, for people alone.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

from sbi_active.campaign.state import CampaignState
from sbi_active.campaign.storage.codec import NotStorableError, encode
from sbi_active.campaign.telling import LOG, STATE, SUMMARY, event_of, now
from sbi_active.expected import require
from sbi_active.messages import Explained
from sbi_active.simulation.bank.bank import Bank
from sbi_active.simulation.bank.fingerprint import fingerprint
from sbi_active.simulation.bank.store import NAME, Store

FORMAT, SCHEMA = "sbi-active campaign", 3  # schema 1 was a folder of files
MANIFEST, BELIEF = "campaign", "belief"
FOR_PEOPLE = "campaign.toml"
UNTOLD = ("packages", "simulator", "own")  # what people are not told
#: What a state holds beside the settings of the campaign.
SAVED = ("trials", "processed", "draws", "versions", "is_stale", "batches")


class LogChangedError(Explained, ValueError):
    """Another writer added to a campaign since it was loaded here."""

    code = "SA607"


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
        self.bank: str | None = None
        self.events: list[dict[str, Any]] = []
        self._written: Any = None  # the belief that is on the disk
        self._banks: dict[str, Bank] = {}
        self._shared: Store | None = None  # the file of ``bank``
        self.store: Any = None
        if path is not None:
            self.store = Store(path, "campaign")
            self._require_campaign()
            with self.store.reading():
                for number in range(1, self.store.length(LOG) + 1):
                    self.events.append({**self.store.json(LOG, number), "line": number})
                    _ = self.events[-1]["event"]

    def _require_campaign(self) -> None:
        found = self.store.json(MANIFEST) or {}
        self.manifest, form = found, (found.get("format"), found.get("schema"))
        require(
            form == (FORMAT, SCHEMA),
            f"a campaign of schema {SCHEMA} in {self.store.path}",
            f"{form[1]} of {found.get('packages')}" if found else "none",
            "use the release of sbi-active that wrote it, or make one by directory=",
        )

    def find_bank(
        self, name: str | None, simulator: Callable[..., Any], version: int
    ) -> Bank | None:
        """Return the bank of a form of the current simulator, open for writing.

        Args:
            name: Name of the form; None for another simulator, which has no bank.
            simulator: Simulator whose rows are to be kept.
            version: Number of the current simulator.
        """
        if name is None or self.store is None and self.bank is None:
            return None
        changes = 0 if self.bank is not None else len(self.changes)
        name += f"-model-{version}" * (version > 0)
        name += f"-changed-{changes}" * (changes > 0)
        if self.bank is not None and self._shared is None:
            self._shared = Store(Path(self.bank), make=True)
        if name not in self._banks:
            place = self._shared or self.store
            self._banks[name] = Bank(place, simulator=simulator, name=name)
        return self._banks[name]

    @property
    def changes(self) -> list[dict[str, Any]]:
        """The events by which the simulator was changed."""
        return [event for event in self.events if event["event"] == "simulator changed"]

    def write(self, event: str, trial: Any = None, **entries: Any) -> None:
        """Add to the log; it is on the disk when this returns.

        Args:
            event: Event that is written.
            trial: The trial as it is afterwards, or its facts.
            **entries: JSON data.
        """
        if self.store is not None:
            line = json.loads(json.dumps(event_of(event, trial, **entries)))
            with self._writing():
                number = self.store.append(LOG, line)
            self.events.append({**line, "line": number})  # as it is read again

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
        known = {"simulator": learner.simulator, "prior": self.prior}
        saved = {
            **{name: getattr(state, name) for name in SAVED},
            **{"lines": len(self.events), "num_simulated": state.meter.spent},
            "belief": belief is not None,
        }
        contents = {STATE: encode(saved, known={}), SUMMARY: b"{}"}
        if belief is not self._written:
            contents[BELIEF] = b""
            with suppress(NotStorableError):
                contents[BELIEF] = encode(belief, known=known)
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
            raise LogChangedError(
                f"expected the campaign in {self.path} as it was loaded; got trials "
                "that another process told since; load it again, and tell this once "
                "more: nothing was written"
            )


def make_campaign(
    folder: Path,
    state: CampaignState,
    given: Mapping[str, Any],
    simulator: Callable[..., Any],
    **facts: Any,
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
    objects = {}
    for what, thing in given.items():
        with suppress(NotStorableError):
            objects[what] = encode(thing, known={})
    names = ("sbi-active", "sbi", "torch", "numpy")
    declared = ("parameter_names", "channel_names")
    own = {name: getattr(simulator, name, None) for name in declared}
    manifest = {
        "created": now(),
        "packages": {"python": platform.python_version()}
        | {n: version(n) for n in names},
        **{name: getattr(state, name) for name in ("method", "seed", "num_earlier")},
        **{name: found if found is None else [*found] for name, found in own.items()},
        **facts,
        **{f"{what}_text": repr(thing) for what, thing in given.items()},
        "simulator": fingerprint(simulator),
    }
    write_campaign(folder, manifest, objects)


def write_campaign(
    folder: Path, manifest: Mapping[str, Any], objects: Mapping[str, bytes]
) -> None:
    """Write a manifest, the objects beside it, and a text for people.

    Raises:
        ValueError: If the folder holds anything.
        OSError: If it cannot be written.
    """
    store = Store(folder, "campaign", make=True)
    if store.catalog:
        raise ValueError(
            f"expected an empty folder for a new campaign; got {folder} with a "
            "campaign; go on with it by Campaign.load(directory, simulator=...), or "
            "choose another folder"
        )
    with store.writing():
        for kind, content in objects.items():
            store.put(kind, 0, content)
        store.put(MANIFEST, 0, {**manifest, "format": FORMAT, "schema": SCHEMA})
    store.close()
    lines = [f"# What this campaign is, for people. {NAME} has all; this is not read."]
    # A text of JSON is one of TOML.
    plain = {k: v for k, v in manifest.items() if v is not None and k not in UNTOLD}
    lines += [f"{k.removesuffix('_text')} = {json.dumps(v)}" for k, v in plain.items()]
    (folder / FOR_PEOPLE).write_text("\n".join([*lines, ""]), encoding="utf-8")
