"""A campaign's simulator compared with its trials, and replaced."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.campaign.learning.learner import Learner
from sbi_active.campaign.learning.pooled import make_learner
from sbi_active.campaign.state import UNSCORED, CampaignState, ModelVersion, Trial
from sbi_active.expected import require
from sbi_active.seeding import derive_seed
from sbi_active.simulation import SimulatorModel

if TYPE_CHECKING:
    from sbi_active.criticism import Criticism, Effect, Report


def compare(
    state: CampaignState,
    simulator: Callable[..., Any],
    prior: Distribution,
    actions: ActionSpace,
    *,
    trials: Sequence[Trial],
    effects: Sequence[Effect],
) -> Criticism:
    """Return the comparison of a campaign's simulator with its trials.

    Args:
        state: State of the campaign.
        simulator: The current one; a plain callable is the draw.
        prior: Prior of its parameters.
        actions: The permitted ones.
        trials: Trials to compare it with.
        effects: Effects that it may lack; those already adopted are left out.
    """
    # Criticism reads results of everything below, so it is imported where it is used.
    from sbi_active.criticism import Criticism, Trials
    from sbi_active.criticism.effects.effect import require_kind

    require_kind(effects)
    expected = "at least two trials to compare"
    require(len(trials) >= 2, expected, len(trials), "run more trials first")
    if not isinstance(simulator, SimulatorModel):
        simulator = SimulatorModel(simulator)
    outcomes = [t.x for t in trials if t.x is not None]
    adopted = state.version.effects
    return Criticism(
        simulator,
        prior,
        Trials(
            torch.stack([t.action for t in trials]),
            torch.stack(outcomes),
            index=[t.index for t in trials],
        ),
        effects=[e for e in effects if e.name not in adopted],
        actions=actions,
        seed=derive_seed(state.seed, "criticism", len(trials)),
    )


def revise(state: CampaignState, actions: ActionSpace, report: Report) -> Learner:
    """Return the learner of a report's simulator, which has learned all trials.

    The state gains a version; nothing changes where this raises.

    Args:
        state: State of the campaign.
        actions: Action space of the campaign.
        report: Report whose verdict names effects.
    """
    if not hasattr(report, "tracing"):
        raise TypeError(
            f"expected a report; got {report!r:.80}; pass what criticize() returned"
        )
    chosen = report.tracing.chosen
    expected, got = "a report whose verdict names effects", repr(report.verdict)
    advice = "criticize(effects) with further effects, or after further trials"
    require(bool(chosen), expected, f"the verdict {got}, which adds none", advice)
    before = state.version
    added: Any = getattr(report.simulator, "effects", ())
    names = [e.name for e in added if e.scope == "campaign"]
    is_own = report.digest in before.examined and names == [*before.effects, *chosen]
    expected = f"a report of the current model, version {before.number}"
    require(is_own, expected, "one of another", "criticize() again")
    state.versions.append(
        ModelVersion(
            number=before.number + 1,
            effects=(*names,),
            digest=report.digest,
            num_trials=len(state.measured),
            trials=(*state.processed,),
        )
    )
    batches = [*state.batches]
    state.batches.clear()  # they are of another simulator
    try:
        revised = make_learner(report.simulator, report.prior, actions, state)
        _infer_at_once(state, revised)
    except BaseException:
        state.versions.pop()
        state.batches[:] = batches
        raise
    return revised


def _infer_at_once(state: CampaignState, learner: Learner) -> None:
    """Have the current model learn the trials before its adoption."""
    version = state.version
    before = [t for i in version.trials if (t := state.trials[i]).is_measured]
    with state.watched(len(state.trials), "inference from all trials"):
        misfit = learner.infer(before)
    state.versions[-1] = replace(version, misfit=misfit)
    state.processed[:] = version.trials
    state.keep_draws(learner.belief)


def require_effects(what: str, names: Sequence[str], effects: Sequence[Effect]) -> None:
    """Raise a ValueError if effects of a campaign are not among those that are given.

    Args:
        what: Words for the effects of these names.
        names: Names of effects.
        effects: Effects that are given.
    """
    from sbi_active.criticism.effects.effect import require_kind

    require_kind(effects)
    lacking = {*names} - {effect.name for effect in effects}
    got = f"none named {', '.join(sorted(map(str, lacking)))}"
    advice = "pass effects= as they were declared"
    require(not lacking, f"{what}, {', '.join(map(str, names))}", got, advice)


def rebuilt(
    state: CampaignState,
    simulator: Callable[..., Any],
    prior: Distribution,
    actions: ActionSpace,
    effects: Sequence[Effect],
) -> tuple[Callable[..., Any], Distribution]:
    """Return the simulator and the prior of the current version, made anew.

    Args:
        state: State of the campaign.
        simulator: Simulator that it began with.
        prior: Prior that it began with.
        actions: The permitted ones.
        effects: Effects, among them those that were adopted.

    Raises:
        ValueError: If an adopted effect is not among them.
    """
    for before, version in itertools.pairwise(state.versions):
        added = [name for name in version.effects if name not in before.effects]
        require_effects("the effects that the campaign adopted", added, effects)
        then = replace(state, versions=[before], trials=state.trials)
        trials = [t for i in version.trials if (t := state.trials[i]).is_measured]
        criticism = compare(
            then, simulator, prior, actions, trials=trials, effects=effects
        )
        simulator, prior = criticism.add(added)
    return simulator, prior


def recompute(state: CampaignState, learner: Learner) -> None:
    """Start again, as if what trials say now had been told from the start.

    The trials behind an adoption are given to the current model at once, as in the
    adoption; all others are left to be scored and learned one after another.

    Args:
        state: State of the campaign; its trials lose their scores.
        learner: Learner of the current model; its belief is that of the adoption, or
            the prior.
    """
    state.processed.clear()
    state.draws.clear()
    for trial in state.trials:
        if trial.status != "pending":
            state.change(trial.index, **UNSCORED)
    learner.restart()
    if state.version.trials:
        _infer_at_once(state, learner)
    state.is_stale = False
