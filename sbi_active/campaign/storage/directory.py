"""The folder of a campaign: what it is, what happened, and what follows from it.

All is in one file, ``store.db``. What the campaign is never changes; what was asked,
told and decided is only added to. Everything else can be computed from these two and
the simulator: the stored state, belief and simulated rows only save that work.
``campaign.toml`` describes the campaign for people and is never read.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, closing, nullcontext, suppress
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar

import torch

from sbi_active.campaign import telling
from sbi_active.campaign.isolation import guarded, isolated
from sbi_active.campaign.learning.pooled import make_learner
from sbi_active.campaign.learning.revision import rebuilt, require_effects
from sbi_active.campaign.state import CampaignState
from sbi_active.campaign.storage.codec import Absent, NotStorableError, decode, encode
from sbi_active.campaign.telling import LOG, STATE, SUMMARY
from sbi_active.expected import require
from sbi_active.messages import warn
from sbi_active.seeding import forked_generators
from sbi_active.simulation.bank.bank import Bank
from sbi_active.simulation.bank.store import NAME, Store, whole
from sbi_active.simulation.fingerprint import fingerprint, require_same
from sbi_active.simulation.model import SimulatorModel
from sbi_active.simulation.workers.store import metering

MANIFEST, BELIEF, FOR_PEOPLE = "campaign", "belief", "campaign.toml"
#: What a state holds beside the settings of the campaign.
SAVED = ("trials", "processed", "draws", "versions", "is_stale", "batches")
Method = TypeVar("Method", bound=Callable[..., Any])
#: Settings of a prior or a space; the source of its class may change.
settings = functools.partial(fingerprint, version="settings")


class Storage:
    """Keeps a campaign and its simulations in a folder, or neither.

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
        events: Lines of its log.
        prior: Prior that the campaign began with.

    Raises:
        ValueError: If the folder holds no campaign, or one of another format.
        CorruptSegmentError: If the file does not hold what was written.
    """

    def __init__(self, path: Path | None = None, *, prior: Any = None) -> None:
        self.path, self.prior = path, prior
        self.store: Any = None
        self.manifest: dict[str, Any] = {}
        self.events: list[dict[str, Any]] = []
        self._banks: dict[str, Bank] = {}
        if path is not None:
            self.store = Store(path, "campaign")
            self.manifest = self.store.json(MANIFEST) or {}
            require("method" in self.manifest, "a campaign", "a bank", "use Bank(DIR)")

    @property
    def changes(self) -> list[Any]:
        """Fingerprints of the simulators that took the place of the one before."""
        return [e["simulator"] for e in self.events if "simulator" in e]

    def find_bank(self, simulator: Any, *, own: Any, version: int) -> Bank | None:
        """Return the bank of a simulator's rows, open for writing.

        Args:
            simulator: Simulator whose rows are to be kept: the current one, or the same
                without its noise. Others have none.
            own: The current simulator.
            version: Number of the current simulator.
        """
        if self.store is None or not (simulator is own or is_mean(simulator, own)):
            return None
        name, changes = "drawn" if simulator is own else "noise-free", len(self.changes)
        name = f"{name}-model-{version}" if version else name
        name = f"{name}-changed-{changes}" if changes else name
        if name not in self._banks:
            self._banks[name] = Bank(self.store, simulator=simulator, name=name)
        return self._banks[name]

    def write(self, event: str, trial: Any = None, **entries: Any) -> None:
        """Add to the log; it is on the disk when this returns.

        Args:
            event: Event that is written.
            trial: The trial as it is afterwards, or its facts.
            **entries: JSON data.
        """
        if self.store is not None:
            line = telling.event_of(event, trial, **entries)
            with self.writing():
                self.store.append(LOG, json.dumps(line).encode())
            self.events.append(line)

    def save(self, state: CampaignState, learner: Any) -> None:
        """Write what follows from the log so far.

        A belief that cannot be stored is computed again by who loads the campaign.

        Args:
            state: State of the campaign.
            learner: Learner of the campaign, whose belief is after ``state.processed``.
        """
        if self.store is None:
            return
        saved = {name: getattr(state, name) for name in SAVED}
        saved |= {"lines": len(self.events), "num_simulated": state.meter.spent}
        contents = {STATE: encode(saved, known={}), SUMMARY: b"{}", BELIEF: b""}
        known = {"simulator": learner.simulator, "prior": self.prior}
        with suppress(NotStorableError):
            contents[BELIEF] = encode(learner.belief, known=known)
        with self.writing():
            for kind, content in contents.items():
                self.store.put(kind, content)

    def sum_up(self, known: Mapping[str, Any]) -> None:
        """Leave what a reader without torch needs, as far as the log goes now.

        Args:
            known: Facts, as JSON data with NaN.
        """
        content = json.dumps({"lines": len(self.events), **known}).encode()
        with self.writing():
            self.store.put(SUMMARY, content)

    def close(self) -> None:
        """Let others write."""
        if self.store is not None:
            self.store.close()

    def writing(self) -> AbstractContextManager[None]:
        """Return the block in which to write, with the right to, which stays.

        Raises:
            LockedError: If another process has it.
            LogChangedError: If another process wrote since the campaign was loaded.
        """
        store, num = self.store, len(self.events)
        return nullcontext() if store is None else store.writing(LOG, num)


def make_campaign(
    folder: Path, given: Mapping[str, Any], facts: Mapping[str, Any]
) -> None:
    """Write what a new campaign is, and a text for people.

    Args:
        folder: Folder, which is made where there is none.
        given: Prior, actions and options.
        facts: Facts to note, as JSON data.

    Raises:
        ValueError: If the folder holds anything.
        OSError: If it cannot be written.
    """
    objects, manifest = {}, dict(facts)
    for what, thing in given.items():
        manifest |= {f"{what}_text": repr(thing), f"{what}_settings": settings(thing)}
        with suppress(NotStorableError):
            objects[what] = encode(thing, known={})
    store = Store(folder, "campaign", make=True)
    expected, got = "an empty folder for a new campaign", f"{folder} with one"
    advice = "go on by Campaign.load(directory, simulator=...) or choose another folder"
    require(not store.catalog, expected, got, advice)
    with closing(store), store.writing():
        for kind, content in {MANIFEST: manifest, **objects}.items():
            store.put(kind, content)
    lines = [f"# What this campaign is, for people. {NAME} has all; this is not read."]
    for key, value in manifest.items():  # a text of JSON is one of TOML
        if isinstance(value, str | int | list):
            lines.append(f"{key.removesuffix('_text')} = {json.dumps(value)}")
    (folder / FOR_PEOPLE).write_text("\n".join([*lines, ""]), encoding="utf-8")


def facts_of(state: CampaignState, simulator: Any) -> dict[str, Any]:
    """Return what is noted of a new campaign: its method, seed, simulator, release."""
    own = {n: getattr(simulator, n, None) for n in ("parameter_names", "channel_names")}
    facts = {"created": telling.now(), "release": version("sbi-active")}
    facts |= {name: found and [*found] for name, found in own.items()}
    facts |= {"method": state.method, "seed": state.seed}
    return {**facts, "simulator": fingerprint(simulator)}


def load(
    storage: Storage,
    simulator: Callable[..., Any] | None,
    *,
    given: Mapping[str, Any],
    effects: Sequence[Any],
    limits: Sequence[str],
    simulator_changed: bool,
) -> Any:
    """Return the learner of a campaign, where it was left; without a simulator, facts.

    Args:
        storage: The campaign's, which gets its first prior.
        simulator: Simulator that it was made with; None to read it.
        given: Prior, actions and options; None for what the folder has.
        effects: Effects that it was made with, and those that were adopted.
        limits: Limits of actions that are given, "cost" and "constraint".
        simulator_changed: Whether the simulator takes the place of the one before.

    Raises:
        NotStorableError: If it was made with anything that only its author can make
            again, and that is not given.
        ValueError: If these are not what it was made with.
    """
    manifest, store, found = storage.manifest, storage.store, dict(given)
    with store.reading():
        kept = {what: decode(store.get(what), known={}) for what in given}
        shape, bounded = torch.Size(manifest["x_shape"]), [*manifest["limits"]]
    for what, thing in kept.items():
        found[what] = thing if given[what] is None else given[what]
        if found[what] is None:
            text = f"expected {what}=, which only its author can make again; got None"
            made = f"{manifest[f'{what}_text']:.200}"
            raise NotStorableError(f"{text}; pass what it was made with: {made}")
        before = manifest.get(f"{what}_settings")  # those of release 0.1 may be lost
        if before and what != "options" and given[what] is not None:
            require_same("the campaign", before, settings(given[what]), what)
    if kept["options"] not in (None, found["options"]):
        text = f"SA604 options= hold for this process: {storage.path} keeps"
        warn(f"{text} {manifest['options_text']}; pass them at each load")
    storage.prior = prior = found["prior"]
    with store.reading():
        state = CampaignState(manifest["method"], manifest["seed"], found["options"])
        content = restore(state, storage)

    def read(known: Mapping[str, Any]) -> Any:
        belief = decode(content, known=known)
        if belief is not None:
            with forked_generators(0):  # one of other code may lack attributes
                belief.sample(torch.Size([1]))
        return belief

    def saved(model: Any) -> Any:
        known = {"simulator": model, "prior": prior}
        belief = _again(BELIEF, functools.partial(read, known))
        state.is_stale |= belief is None and bool(state.processed)
        return belief or prior

    if simulator is None:
        belief = saved(Absent())
        own = {"belief": belief, "prior": getattr(belief, "prior", prior)}
        own |= {"simulator": None, "actions": found["actions"], "x_shape": shape}
        return SimpleNamespace(**own, state=state, _saved=None)
    expected = f"the limits of actions that were declared, {bounded}"
    require(limits == bounded, expected, limits, "pass cost=, constraint=")
    require_effects("the effects of the campaign", manifest["effects"], effects)
    mine = fingerprint(simulator)
    if simulator_changed:
        storage.write("simulator changed", simulator=mine)
        state.apply(storage.events[-1])
    else:
        before = [manifest["simulator"], *storage.changes][-1]
        require_same("the campaign", before, mine)
    model, joint = rebuilt(state, simulator, prior, found["actions"], effects)
    learner = make_learner(model, joint, found["actions"], state, x_shape=shape)
    if state.processed and not state.is_stale:
        learner.resume(functools.partial(saved, model))
    return learner


def restore(state: CampaignState, storage: Storage) -> bytes | None:
    """Bring a new state to where the log ends, and return the belief, encoded.

    Another process may be writing: all of it is for one look at the file.

    Args:
        state: State that is changed in place; ``is_stale`` where beliefs must be
            computed again.
        storage: Storage, which gets the events of the log.
    """
    store = storage.store
    numbers = range(1, store.catalog.get(LOG, 0) + 1)
    storage.events = [store.json(LOG, number) or {} for number in numbers]
    _ = [event["event"] for event in storage.events]  # of a crafted one
    saved = _again(STATE, lambda: decode(store.get(STATE), known={})) or {}
    num = saved.pop("lines", 0)
    whole(store.path, num <= len(storage.events), f"no 'log' {num}: a gap")
    state.meter.spent = saved.pop("num_simulated", 0)
    vars(state).update({name: saved[name] for name in SAVED if saved})
    for event in storage.events[num:]:
        state.apply(event)
    state.is_stale |= not saved and len(state.versions) > 1
    return _again(BELIEF, lambda: store.get(BELIEF))


def _again(what: str, read: Callable[[], Any]) -> Any:
    """Return what was computed; None where it has to be computed again."""
    try:
        return read()
    except (OSError, ValueError, AttributeError, TypeError) as error:
        warn(f"SA601 the {what} has to be computed again: {error}")
        return None


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
        advice = "pass it: Campaign.load(directory, simulator=...)"
        require(own is not None, "the simulator, which no folder has", "none", advice)
        with storage.writing():  # before anything is computed
            pass
        find = functools.partial(storage.find_bank, own=own, version=version)
        with metering(campaign.state.meter, find):
            return apart(campaign, *arguments, **options)

    return kept  # type: ignore[return-value]


def is_mean(simulator: Any, own: Any) -> bool:
    """Return whether a simulator is another one without its noise."""
    if not (isinstance(simulator, SimulatorModel) and isinstance(own, SimulatorModel)):
        return False
    parts = [(m.fn, *getattr(m, "effects", ())) for m in (simulator, own)]
    is_same = [*map(id, parts[0])] == [*map(id, parts[1])]
    return is_same and simulator.noise is None and own.noise is not None
