"""A campaign in a folder, loaded to go on, or to be read without its simulator."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import torch

from sbi_active.campaign.learning.pooled import make_learner
from sbi_active.campaign.learning.revision import rebuilt, require_effects
from sbi_active.campaign.state import CampaignState
from sbi_active.campaign.storage.codec import Absent, NotStorableError, decode
from sbi_active.campaign.storage.directory import BELIEF, SAVED, Storage
from sbi_active.campaign.telling import STATE
from sbi_active.expected import require
from sbi_active.messages import warn
from sbi_active.seeding import forked_generators
from sbi_active.simulation.bank.errors import whole
from sbi_active.simulation.fingerprint import fingerprint, require_same


def load(
    storage: Storage,
    simulator: Callable[..., Any] | None,
    *,
    given: Mapping[str, Any],
    effects: Sequence[Any],
    limits: Mapping[str, Any],
    simulator_changed: bool,
) -> Any:
    """Return the learner of a campaign, where it was left; without a simulator, facts.

    Args:
        storage: The campaign's, which gets its first prior.
        simulator: Simulator that it was made with; None to read it.
        given: Prior, actions and options; None for what the folder has.
        effects: Effects that it was made with, and those that were adopted.
        limits: Cost and constraint of actions.
        simulator_changed: Whether the simulator takes the place of the one before.

    Raises:
        NotStorableError: If it was made with anything that only its author can make
            again, and that is not given.
        ValueError: If these are not what it was made with.
    """
    manifest, store, found = storage.manifest, storage.store, dict(given)
    with store.reading():
        lost = manifest.get("own", ())  # there draws stand for them, as they did once
        kept = {w: None if w in lost else _decoded(store.get(w)) for w in given}
        facts = {name: manifest[name] for name in ("method", "seed")}
        shape = torch.Size(manifest["x_shape"])
    for what, thing in kept.items():
        found[what] = thing if given[what] is None else given[what]
        if found[what] is None:
            text = f"expected {what}=, which only its author can make again; got None"
            made = f"{manifest[f'{what}_text']:.200}"
            raise NotStorableError(f"{text}; pass what it was made with: {made}")
        before = manifest.get(f"{what}_settings") or thing and _settings(thing)
        if before and what != "options" and given[what] is not None:
            require_same("the campaign", before, _settings(given[what]), what)
    with store.reading():
        state = CampaignState(**facts, options=found["options"])
        content = restore(state, storage)
    if kept["options"] not in (None, found["options"]):
        text = f"the campaign in {storage.path} keeps {manifest['options_text']}"
        text = f"SA604 options= hold for this process: {text}; pass them at each load"
        warn(text)
    storage.prior = prior = found["prior"]

    def saved(model: Any) -> Any:
        known = {"simulator": model, "prior": prior}
        belief = _again(BELIEF, lambda: _sampled(_decoded(content, known)))
        state.is_stale |= belief is None and bool(state.processed)
        return belief or prior

    if simulator is None:
        own = {"simulator": None, "belief": saved(Absent()) if content else prior}
        own |= {"prior": getattr(own["belief"], "prior", prior), "x_shape": shape}
        own |= {"actions": found["actions"], "state": state, "_saved": None}
        return SimpleNamespace(**own)
    for what, limit in limits.items():
        as_before = (limit is not None) == manifest[f"has_{what}"]
        expected = f"{what}= {'as declared' if limit is None else 'left out'}"
        got = "none" if limit is None else "one"
        require(as_before, expected, got, "pass what the campaign was made with")
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
    if content and not state.is_stale:
        learner.resume(functools.partial(saved, model))
    return learner


def restore(state: CampaignState, storage: Storage) -> bytes | None:
    """Bring a new state to where the log ends, and return the belief, encoded.

    Args:
        state: State that is changed in place; ``is_stale`` where beliefs must be
            computed again.
        storage: Storage with the log.
    """
    store = storage.store
    saved = _again(STATE, lambda: _decoded(store.get(STATE))) or {}
    num = saved.get("lines", 0)
    whole(store.path, num <= len(storage.events), f"no 'log' {num}: a gap")
    for name in SAVED if saved else ():
        setattr(state, name, saved[name])
    state.meter.spent = saved.get("num_simulated", 0)
    for event in storage.events[num:]:
        state.apply(event)
    has_belief = saved.get("belief")
    content = _again(BELIEF, lambda: store.get(BELIEF)) if has_belief else None
    lost = has_belief and not content and state.processed
    state.is_stale |= bool(lost or not saved and len(state.versions) > 1)
    return content


#: Settings of a prior or a space; the source of its class may change.
_settings = functools.partial(fingerprint, version="settings")


def _decoded(content: bytes | None, known: Mapping[str, Any] | None = None) -> Any:
    return decode(content, known=known or {}) if content else None


def _sampled(belief: Any) -> Any:
    """Return a belief that gives draws: of other code it may lack attributes."""
    if belief is not None:
        try:
            with forked_generators(0):
                belief.sample(torch.Size([1]))
        except (AttributeError, TypeError) as error:
            raise ValueError(
                f"expected a belief of this release; got {error}"
            ) from error
    return belief


def _again(what: str, read: Callable[[], Any]) -> Any:
    """Return what was computed; None where it has to be computed again."""
    try:
        return read()
    except (OSError, ValueError) as error:
        warn(f"SA601 the {what} has to be computed again: {error}")
        return None
