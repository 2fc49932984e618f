"""A campaign from its folder."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import torch
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.campaign.health import doubts, in_doubt
from sbi_active.campaign.learning.learner import Learner
from sbi_active.campaign.learning.pooled import make_learner
from sbi_active.campaign.learning.revision import rebuilt
from sbi_active.campaign.options import CampaignOptions
from sbi_active.campaign.state import CampaignState
from sbi_active.campaign.storage.codec import Absent
from sbi_active.campaign.storage.damage import reading
from sbi_active.campaign.storage.described import (
    actions_from,
    describe_options,
    options_from,
    prior_from,
)
from sbi_active.campaign.storage.directory import CampaignDirectory, apply
from sbi_active.campaign.storage.drawn import drawn_from, stood_for
from sbi_active.campaign.storage.manifest import require_same_simulator
from sbi_active.messages import warn
from sbi_active.simulation.bank.fingerprint import fingerprint

if TYPE_CHECKING:
    from sbi_active.criticism import Effect


@dataclass(frozen=True)
class Loaded:
    """The parts of a campaign."""

    disk: CampaignDirectory
    state: CampaignState
    actions: ActionSpace
    learner: Learner | StoredLearner
    prior: Distribution


class StoredLearner:
    """A campaign's learner as far as it is known without the simulator.

    Args:
        prior: Prior that the campaign began with.
        x_shape: Shape of an outcome.
        state: State of the campaign.
        belief: Function that returns the belief, read when it is first asked for; None
            for none.
        parameter_names: Names of the parameters, if they have any.

    Attributes:
        first_prior: Prior that the campaign began with.
        x_shape: Shape of an outcome.
    """

    simulator = None

    def __init__(
        self,
        prior: Distribution,
        x_shape: torch.Size,
        state: CampaignState,
        belief: Callable[[], Distribution] | None,
        parameter_names: Sequence[str] | None,
    ) -> None:
        self.parameter_names = parameter_names
        self.first_prior, self.x_shape, self._state = prior, x_shape, state
        self._saved, self._belief = belief, prior

    @property
    def prior(self) -> Distribution:
        """The original prior, times those of the effects that were adopted."""
        return getattr(self.belief, "prior", self.first_prior)

    @property
    def belief(self) -> Distribution:
        """The belief when the campaign was last brought up to date."""
        saved, self._saved = self._saved, None
        if saved is not None:
            try:
                self._belief = stood_for(saved(), self.first_prior, self._state)
            except ValueError as error:
                warn(
                    f"SA601 the belief has to be computed again: {error}",
                    stacklevel=3,
                )
                self._state.is_stale = True
        return self._belief

    @property
    def stated_belief(self) -> Distribution:
        """That, marked untrustworthy where trials are not in it."""
        texts = doubts(self._state.measured)
        if self._state.is_stale:
            texts.append(
                "SA601 trials were told or corrected since: update() computes it again"
            )
        return in_doubt(self.belief, self.prior, texts)

    def __getattr__(self, name: str) -> NoReturn:
        if name.startswith("__"):
            raise AttributeError(name)
        raise ValueError(
            "expected the simulator, which is not stored with a campaign; got none; "
            "pass it: Campaign.load(directory, simulator=...)"
        )


def load(
    directory: str | os.PathLike[str],
    *,
    simulator: Callable[..., Any] | None,
    prior: Distribution | None,
    actions: ActionSpace | None,
    effects: Sequence[Effect],
    options: CampaignOptions | None,
    has_cost: bool,
    has_constraint: bool,
    simulator_changed: bool,
    repair: bool,
) -> Loaded:
    """Return the parts of a campaign, see :meth:`.Campaign.load`."""
    disk = CampaignDirectory(Path(directory), repair=repair)
    manifest = disk.manifest
    settings: CampaignOptions = _given("options", options, disk, options_from)
    kept = manifest.get("options")
    known = None if kept is None else describe_options(options_from(kept))
    if options is not None and describe_options(options) != known:
        warn(
            f"SA604 options= hold for this process: the campaign in {directory} keeps "
            f"{manifest.get('options_text')}; pass them at each load",
            stacklevel=4,
        )
    reads = simulator is None
    space: ActionSpace = _given("actions", actions, disk, actions_from, reads=reads)
    first_prior: Distribution = _given("prior", prior, disk, prior_from, reads=reads)
    with reading(disk.store.path):
        state = CampaignState(
            manifest["method"],
            manifest["seed"],
            settings,
            num_earlier=manifest["num_earlier"],
        )
        shape = torch.Size(manifest["x_shape"])
    name = disk.restore(state)
    for note in disk.notes:
        warn(note, stacklevel=3)
    if simulator is None:
        without = {"simulator": Absent(), "prior": first_prior}
        saved = None if name is None else lambda: disk.belief(name, without)
        reader = StoredLearner(
            first_prior, shape, state, saved, manifest["parameter_names"]
        )
        return Loaded(disk, state, space, reader, first_prior)
    for what, given in (("cost", has_cost), ("constraint", has_constraint)):
        if given != manifest[f"has_{what}"]:
            raise ValueError(
                f"expected {what}= {'left out' if given else 'as declared'}; got "
                f"{'one' if given else 'none'}; pass what the campaign was made with"
            )
    lacking = {*manifest["effects"]} - {effect.name for effect in effects}
    if lacking:
        raise ValueError(
            f"expected the effects {manifest['effects']}; got none named "
            f"{', '.join(sorted(lacking))}; pass effects= as they were declared"
        )
    if simulator_changed:
        disk.write("simulator changed", simulator=fingerprint(simulator))
        apply(state, disk.events[-1])
    else:
        require_same_simulator(manifest, simulator)
    model, joint = rebuilt(state, simulator, first_prior, space, effects)
    learner = make_learner(model, joint, space, state, x_shape=shape)
    if name is not None and not state.is_stale:
        known = {"simulator": model, "prior": first_prior}
        learner.resume(lambda: _belief(disk, name, known, learner))
    return Loaded(disk, state, space, learner, first_prior)


def _belief(
    disk: CampaignDirectory, name: str, known: dict[str, Any], learner: Learner
) -> Distribution:
    """Return the belief, or the prior where all has to be computed again."""
    try:
        return disk.belief(name, known)
    except ValueError as error:
        warn(f"SA601 the belief is computed again: {error}", stacklevel=4)
        learner.forget()
        return learner.prior


def _given(
    what: str,
    given: Any,
    disk: CampaignDirectory,
    made: Callable[[Any], Any],
    *,
    reads: bool = False,
) -> Any:
    """Return what was passed, or else what the manifest describes.

    Readers get what stands for it where it is a class of its author's own.
    """
    if given is not None:
        return given
    with reading(disk.store.path):
        described, text = disk.manifest[what], disk.manifest[f"{what}_text"]
        drawn = disk.manifest["drawn"].get(what)
        if reads and drawn is not None:
            return drawn_from(drawn)
    if described is None:
        raise ValueError(
            f"expected {what}=, which only its author can make again; got None; pass "
            f"what the campaign was made with: {text:.200}"
        )
    with reading(disk.store.path):
        return made(described)
