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
from sbi_active.campaign.storage.codec import Absent, decode
from sbi_active.campaign.storage.directory import CampaignDirectory, apply
from sbi_active.campaign.storage.drawn import DrawnPrior
from sbi_active.messages import warn
from sbi_active.simulation.bank.fingerprint import differences, fingerprint
from sbi_active.simulation.bank.sqlite import sensible

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
                self._belief = self._shown(saved())
            except ValueError as error:
                warn(
                    f"SA601 the belief has to be computed again: {error}",
                    stacklevel=3,
                )
                self._state.is_stale = True
        return self._belief

    def _shown(self, belief: Any) -> Distribution:
        """Return a belief as read; its draws where there is no density of the prior."""
        kept, processed = self._state.draws, self._state.processed
        known = [index for index in processed if index in kept]
        if not isinstance(self.first_prior, DrawnPrior) or not known:
            return belief
        shown: Any = DrawnPrior(kept[known[-1]])
        for name in ("prior", "label", "parameter_names", "diagnostics"):
            setattr(shown, name, getattr(belief, name))
        return shown

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
    manifest, reads = disk.manifest, simulator is None
    kept = disk.given("options", reads=True)
    if options is not None and kept not in (None, options):
        warn(
            f"SA604 options= hold for this process: the campaign in {directory} keeps "
            f"{manifest['options_text']}; pass them at each load",
            stacklevel=4,
        )
    settings: CampaignOptions = _given("options", options, disk)
    space: ActionSpace = _given("actions", actions, disk, reads=reads)
    first_prior: Distribution = _given("prior", prior, disk, reads=reads)
    with sensible(disk.store.path):
        state = CampaignState(
            manifest["method"],
            manifest["seed"],
            settings,
            num_earlier=manifest["num_earlier"],
        )
        shape = torch.Size(manifest["x_shape"])
    belief = disk.restore(state)
    for note in disk.notes:
        warn(note, stacklevel=3)
    if simulator is None:
        without = {"simulator": Absent(), "prior": first_prior}
        saved = None if belief is None else lambda: decode(belief, known=without)
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
        lines = differences(manifest["simulator"], fingerprint(simulator))
        if lines:
            raise ValueError(
                "expected the simulator of the campaign; got another: "
                f"{'; '.join(lines)}; pass the one it was made with, or "
                "simulator_changed=True to compute everything again with this one"
            )
    model, joint = rebuilt(state, simulator, first_prior, space, effects)
    learner = make_learner(model, joint, space, state, x_shape=shape)
    if belief is not None and not state.is_stale:
        known = {"simulator": model, "prior": first_prior}
        learner.resume(lambda: _belief(belief, known, learner))
    return Loaded(disk, state, space, learner, first_prior)


def _belief(content: bytes, known: dict[str, Any], learner: Learner) -> Distribution:
    """Return the belief, or the prior where all has to be computed again."""
    try:
        return decode(content, known=known)
    except ValueError as error:
        warn(f"SA601 the belief is computed again: {error}", stacklevel=4)
        learner.forget()
        return learner.prior


def _given(
    what: str, given: Any, disk: CampaignDirectory, *, reads: bool = False
) -> Any:
    """Return what was passed, or else what the folder has.

    Readers get what stands for it where it is a class of its author's own.
    """
    if given is not None:
        return given
    found = disk.given(what, reads=reads)
    if found is None:
        raise ValueError(
            f"expected {what}=, which only its author can make again; got None; pass "
            f"what the campaign was made with: {disk.manifest[f'{what}_text']:.200}"
        )
    return found
