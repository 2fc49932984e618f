"""A campaign from its folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NoReturn

import torch
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.campaign.learning.learner import Learner
from sbi_active.campaign.learning.pooled import make_learner
from sbi_active.campaign.learning.revision import rebuilt, require_effects
from sbi_active.campaign.options import CampaignOptions
from sbi_active.campaign.state import CampaignState
from sbi_active.campaign.storage.codec import Absent, decode
from sbi_active.campaign.storage.directory import Storage, apply
from sbi_active.campaign.storage.drawn import DrawnPrior
from sbi_active.messages import warn
from sbi_active.simulation.bank.fingerprint import differences, fingerprint
from sbi_active.simulation.bank.sqlite import sensible

if TYPE_CHECKING:
    from sbi_active.criticism import Effect


class StoredLearner:
    """A campaign's learner as far as it is known without the simulator.

    Args:
        prior: Prior that the campaign began with.
        actions: Action space of the campaign.
        state: State of the campaign.
        x_shape: Shape of an outcome.
        belief: Function that returns the belief, read when it is first asked for; None
            for none.

    Attributes:
        first_prior: Prior that the campaign began with.
        actions: Action space of the campaign.
        state: State of the campaign.
        x_shape: Shape of an outcome.
    """

    simulator = None

    def __init__(
        self,
        prior: Distribution,
        actions: ActionSpace,
        state: CampaignState,
        x_shape: torch.Size,
        belief: Callable[[], Distribution] | None,
    ) -> None:
        self.first_prior, self.actions, self.state = prior, actions, state
        self.x_shape = x_shape
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
            self._belief = self._shown(saved() or self.first_prior)
        return self._belief

    def _shown(self, belief: Any) -> Distribution:
        """Return a belief as read; its draws where there is no density of the prior."""
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
    kept, options = storage.given("options", reads=True), given["options"]
    if options is not None and kept not in (None, options):
        warn(
            f"SA604 options= hold for this process: the campaign in {storage.path} "
            f"keeps {manifest['options_text']}; pass them at each load",
            stacklevel=4,
        )
    settings: CampaignOptions = _given("options", options, storage)
    space: ActionSpace = _given("actions", given["actions"], storage, reads=reads)
    prior: Distribution = _given("prior", given["prior"], storage, reads=reads)
    storage.prior = prior
    with sensible(storage.store.path):
        state = CampaignState(
            manifest["method"],
            manifest["seed"],
            settings,
            num_earlier=manifest["num_earlier"],
        )
        shape = torch.Size(manifest["x_shape"])
    belief = storage.restore(state)
    for note in storage.notes:
        warn(note, stacklevel=3)
    if simulator is None:
        known = {"simulator": Absent(), "prior": prior}
        saved = None if belief is None else lambda: _decoded(belief, known, state)
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


def _decoded(content: bytes, known: dict[str, Any], state: CampaignState) -> Any:
    """Return the belief; None where all has to be computed again."""
    try:
        return decode(content, known=known)
    except ValueError as error:
        warn(f"SA601 the belief has to be computed again: {error}", stacklevel=4)
        state.is_stale = bool(state.processed)
        return None


def _given(what: str, given: Any, storage: Storage, *, reads: bool = False) -> Any:
    """Return what was passed, or else what the folder has.

    Readers get what stands for it where it is a class of its author's own.
    """
    if given is not None:
        return given
    found = storage.given(what, reads=reads)
    if found is None:
        raise ValueError(
            f"expected {what}=, which only its author can make again; got None; pass "
            f"what the campaign was made with: {storage.manifest[f'{what}_text']:.200}"
        )
    return found
