"""A campaign in a folder: written when it begins, and loaded to go on."""

from __future__ import annotations

import functools
import json
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import torch
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.campaign.learning.learner import Learner
from sbi_active.campaign.learning.pooled import make_learner
from sbi_active.campaign.learning.revision import rebuilt, require_effects
from sbi_active.campaign.options import CampaignOptions
from sbi_active.campaign.state import CampaignState
from sbi_active.campaign.storage.codec import Absent, NotStorableError, decode, encode
from sbi_active.campaign.storage.directory import (
    COPY,
    FORMAT,
    MANIFEST,
    SCHEMA,
    Storage,
    apply,
)
from sbi_active.campaign.storage.drawn import DrawnPrior, drawn
from sbi_active.campaign.telling import now
from sbi_active.messages import warn
from sbi_active.simulation.bank.fingerprint import differences, fingerprint
from sbi_active.simulation.bank.sqlite import NAME, sensible
from sbi_active.simulation.bank.store import Store

if TYPE_CHECKING:
    from sbi_active.criticism import Effect

FOR_PEOPLE = "campaign.toml"
UNTOLD = ("packages", "simulator")  # what people are not told


@dataclass(eq=False)
class StoredLearner:
    """A campaign's learner as far as it is known without the simulator.

    Attributes:
        first_prior: Prior that the campaign began with.
        actions: Action space of the campaign.
        state: State of the campaign.
        x_shape: Shape of an outcome.
    """

    simulator = None

    first_prior: Distribution
    actions: ActionSpace
    state: CampaignState
    x_shape: torch.Size
    _saved: Callable[[], Distribution | None] | None  # until the belief is asked for

    @property
    def prior(self) -> Distribution:
        """The original prior, times those of the effects that were adopted."""
        return getattr(self.belief, "prior", self.first_prior)

    @functools.cached_property
    def belief(self) -> Distribution:
        """The belief when the campaign was last brought up to date.

        It is shown by its draws where there is no density of the prior.
        """
        saved, self._saved = self._saved, None
        belief: Any = saved and saved() or self.first_prior
        kept, processed = self.state.draws, self.state.processed
        known = [index for index in processed if index in kept]
        has_density = not isinstance(self.first_prior, DrawnPrior)
        if has_density or belief is self.first_prior or not known:
            return belief
        shown: Any = DrawnPrior(kept[known[-1]])
        for name in ("prior", "label", "parameter_names", "diagnostics"):
            setattr(shown, name, getattr(belief, name))
        return shown

    def __getattr__(self, name: str) -> NoReturn:
        if name.startswith("__"):
            raise AttributeError(name)
        raise ValueError(
            "expected the simulator, which is not stored with a campaign; got none; "
            "pass it: Campaign.load(directory, simulator=...)"
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
    objects: dict[str, bytes] = {}
    own: list[str] = []
    for what, thing in given.items():
        try:
            objects[what] = encode(thing, known={})
        except NotStorableError:
            own.append(what)
            if what != "options":
                objects[what] = encode(drawn(thing, seed=state.seed), known={})
    packages = {name: version(name) for name in ("sbi-active", "sbi", "torch", "numpy")}
    declared = ("parameter_names", "channel_names")
    names = {name: getattr(simulator, name, None) for name in declared}
    manifest = {
        "created": now(),
        "packages": {"python": platform.python_version(), **packages},
        "method": state.method,
        "seed": state.seed,
        "num_earlier": state.num_earlier,
        **{name: found if found is None else [*found] for name, found in names.items()},
        **facts,
        **{f"{what}_text": repr(thing) for what, thing in given.items()},
        "own": own,
        "simulator": fingerprint(simulator),
    }
    write_campaign(folder, manifest, objects)


def write_campaign(
    folder: Path, manifest: Mapping[str, Any], objects: Mapping[str, bytes]
) -> None:
    """Write a manifest, with a copy, the objects beside it, and a text for people.

    Raises:
        ValueError: If the folder holds anything.
        OSError: If it cannot be written.
    """
    store = Store(folder, "campaign", make=True)
    if {*store.catalog} - {"writer"}:
        raise ValueError(
            f"expected an empty folder for a new campaign; got {folder} with a "
            "campaign; go on with it by Campaign.load(directory, simulator=...), or "
            "choose another folder"
        )
    records = {MANIFEST: {**manifest, "format": FORMAT, "schema": SCHEMA}, **objects}
    with store.writing():
        for kind, content in {**records, COPY: records[MANIFEST]}.items():
            store.put(kind, 0, content)
    store.close()
    heading = f"# What this campaign is, for people. All is kept in {NAME}; this is not"
    # A text of JSON is one of TOML.
    plain = {k: v for k, v in manifest.items() if v is not None and k not in UNTOLD}
    lines = [f"{k.removesuffix('_text')} = {json.dumps(v)}" for k, v in plain.items()]
    text = "\n".join([f"{heading} read.", *lines, ""])
    (folder / FOR_PEOPLE).write_text(text, encoding="utf-8")


def load(
    storage: Storage,
    simulator: Callable[..., Any] | None,
    *,
    given: Mapping[str, Any],
    effects: Sequence[Effect],
    limits: Mapping[str, Any],
    simulator_changed: bool,
) -> Learner | StoredLearner:
    """Return the learner of a campaign, where it was left.

    Args:
        storage: The campaign's, which gets its first prior.
        simulator: Simulator that it was made with; None to read it.
        given: Prior, actions and options; None for what the folder has.
        effects: Effects that it was made with, and those that were adopted.
        limits: Cost and constraint of actions.
        simulator_changed: Whether the simulator takes the place of the one before.

    Raises:
        ValueError: If they are not what it was made with.
    """
    manifest, reads = storage.manifest, simulator is None
    options = given["options"]
    with storage.store.reading():
        kept = storage.given("options", reads=True)
        settings: CampaignOptions = _given("options", options, storage)
        space: ActionSpace = _given("actions", given["actions"], storage, reads=reads)
        prior: Distribution = _given("prior", given["prior"], storage, reads=reads)
        with sensible(storage.store.path):
            facts = manifest["method"], manifest["seed"], settings
            state = CampaignState(*facts, num_earlier=manifest["num_earlier"])
            shape = torch.Size(manifest["x_shape"])
        belief = storage.restore(state)
    storage.prior = prior
    if options is not None and kept not in (None, options):
        warn(
            f"SA604 options= hold for this process: the campaign in {storage.path} "
            f"keeps {manifest['options_text']}; pass them at each load",
            stacklevel=4,
        )
    for note in storage.notes:
        warn(note, stacklevel=3)
    if simulator is None:
        known = {"simulator": Absent(), "prior": prior}
        saved = functools.partial(_decoded, belief, known, state)
        return StoredLearner(prior, space, state, shape, saved)
    for what, limit in limits.items():
        if (limit is not None) != manifest[f"has_{what}"]:
            raise ValueError(
                f"expected {what}= {'as declared' if limit is None else 'left out'}; "
                f"got {'none' if limit is None else 'one'}; pass what the campaign was "
                "made with"
            )
    require_effects("the effects of the campaign", manifest["effects"], effects)
    if simulator_changed:
        storage.write("simulator changed", simulator=fingerprint(simulator))
        apply(state, storage.events[-1])
    else:
        lines = differences(manifest["simulator"], fingerprint(simulator))
        if lines:
            raise ValueError(
                "expected the simulator of the campaign; got another: "
                f"{'; '.join(lines)}; pass the one it was made with, or "
                "simulator_changed=True to compute everything again with this one"
            )
    model, joint = rebuilt(state, simulator, prior, space, effects)
    learner = make_learner(model, joint, space, state, x_shape=shape)
    if belief is not None and not state.is_stale:
        known = {"simulator": model, "prior": prior}
        learner.resume(lambda: _decoded(belief, known, state) or learner.prior)
    return learner


def _decoded(content: bytes | None, known: dict[str, Any], state: CampaignState) -> Any:
    """Return the belief; None where there is none, or it has to be computed again."""
    try:
        return None if content is None else decode(content, known=known)
    except ValueError as error:
        warn(f"SA601 the belief has to be computed again: {error}", stacklevel=4)
        state.is_stale = bool(state.processed)
        return None


def _given(what: str, given: Any, storage: Storage, *, reads: bool = False) -> Any:
    """Return what was passed, or else what the folder has.

    Readers get what stands for it where it is a class of its author's own.
    """
    found = storage.given(what, reads=reads) if given is None else given
    if found is None:
        raise ValueError(
            f"expected {what}=, which only its author can make again; got None; pass "
            f"what the campaign was made with: {storage.manifest[f'{what}_text']:.200}"
        )
    return found
