"""The choice of the next trial, for the parameters or for the right model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from sbi_active.campaign.checks.unlike import most_unlike
from sbi_active.campaign.learning.learner import Learner
from sbi_active.campaign.learning.limits import Limits
from sbi_active.campaign.learning.methods import find_method
from sbi_active.campaign.learning.pooled import PooledLearner
from sbi_active.campaign.learning.revision import compare
from sbi_active.campaign.state import CampaignState, Trial
from sbi_active.design.design import Design, equal_errors, naming
from sbi_active.design.designer import InformationGainDesigner
from sbi_active.design.estimators.automatic import ESTIMATORS
from sbi_active.design.random_designer import RandomDesigner
from sbi_active.seeding import derive_seed

if TYPE_CHECKING:
    from sbi_active.criticism import Criticism, Effect

FEWEST_TRIALS = 2  # that rivals can be compared on


class Planner:
    """Designs the trials of a campaign.

    Args:
        limits: The action space, what of it is permitted, and its cost.
        state: State of the campaign.
        effects: Effects that its simulator may lack.

    Attributes:
        effects: Effects that the simulator may lack.
    """

    def __init__(
        self, limits: Limits, state: CampaignState, effects: Sequence[Effect]
    ) -> None:
        from sbi_active.criticism.effects.declarations import (
            require_distinct,
            require_nested,
        )

        require_distinct(effects)
        require_nested(effects)
        self._limits, self._state, self.effects = limits, state, (*effects,)
        options, actions = state.options, limits.actions
        self._designs = find_method(state.method).designs
        self._designer = (
            InformationGainDesigner(
                actions,
                num_samples=options.num_samples,
                estimator=options.estimator,
                eliminate=options.details.eliminate,
                workers=options.workers,
            )
            if self._designs
            else RandomDesigner(actions, workers=options.workers)
        )

    def require(self, target: str | Sequence[str]) -> None:
        """Raise a ValueError if a trial cannot be designed for a target."""
        if target in ("auto", "theta"):
            return
        if not self._designs:
            raise ValueError(
                f"expected target 'auto' or 'theta', since the method "
                f"{self._state.method!r} draws actions at random; got {target!r}; "
                "use a method that designs them, such as 'asbi'"
            )
        told = sum(t.is_measured for t in self._state.trials)
        if target == "model" and not (self.effects and told >= FEWEST_TRIALS):
            lacking = f"{told} trials" if self.effects else "no effects"
            raise ValueError(
                f"expected effects and at least {FEWEST_TRIALS} trials for the target "
                f"'model'; got {lacking}; give Campaign(effects=...), and ask for "
                "'theta' first"
            )

    def compare(
        self,
        learner: Learner,
        trials: Sequence[Trial],
        effects: Sequence[Effect] | None = None,
    ) -> Criticism:
        """Return the comparison of the current simulator with trials.

        Args:
            learner: Learner of the current simulator.
            trials: Trials that gave a measurement, or none.
            effects: Effects that it may lack; None takes the campaign's.
        """
        return compare(
            self._state,
            learner.simulator,
            learner.prior,
            self._limits.permitted(),
            trials=trials,
            effects=self.effects if effects is None else effects,
        )

    def design(
        self,
        index: int,
        target: str | Sequence[str],
        learner: Learner,
        *,
        alarmed: bool,
    ) -> tuple[Design, str]:
        """Return the design of a trial and what it is for.

        Args:
            index: Index of the trial.
            target: Target of the design, see :meth:`.Campaign.ask`.
            learner: Learner of the current simulator.
            alarmed: Whether the simulator no longer explains the trials; then what is
                to be learned about its parameters does not count.
        """
        options = self._state.options
        told = [t for t in self._state.trials if t.is_measured]
        executed = torch.stack([t.action for t in told]) if told else torch.empty(0)
        exclude = None if options.details.repeat or not told else executed
        limits = self._limits.options(exclude)
        limits["min_probability_valid"] = options.details.min_probability_valid
        if not self._designs:
            return self._select(index, learner, self._designer, **limits), "random"
        if target == "auto" and self._checks(index):
            places = most_unlike(self._limits.permitted(exclude), executed)
            designer = RandomDesigner(places, workers=options.workers)
            return self._select(index, learner, designer), "check"
        about_model = None
        # What nothing explains would draw the next trial after it; reports have it.
        trials = self._state.explained
        can_compare = self.effects and len(trials) >= FEWEST_TRIALS
        if target == "model" or (target == "auto" and can_compare):
            with self._state.stage(index, "criticism"):
                about_model = _model_design(
                    self.compare(learner, trials), self._limits, exclude
                )
        if about_model is not None and (target == "model" or alarmed):
            return about_model, "model"
        own = "theta" if target in ("auto", "model") else target
        if isinstance(learner, PooledLearner):
            pooled = learner.design(
                index,
                self._limits.design(exclude, options.details.min_probability_valid),
            )
            if about_model is not None and _utility(about_model) > _utility(pooled):
                return about_model, "model"
            return pooled, "theta"
        model = learner.model(index)
        design = self._select(
            index,
            learner,
            self._designer,
            model,
            target=own,
            cost=self._limits.cost,
            simulations=learner.simulations,
            **limits,
        )
        if model.was_asked:
            learner.note(index, "design" if _rests_on_model(design) else "notes")
        if about_model is not None and _utility(about_model) > _utility(design):
            return about_model, "model"
        return design, own if isinstance(own, str) else ", ".join(own)

    def _select(
        self,
        index: int,
        learner: Learner,
        designer: Any,
        model: Any = None,
        **options: Any,
    ) -> Design:
        # A model that knows single parameters alone has a belief of these.
        belief = getattr(model, "belief", None)
        with self._state.stage(index, "design"):
            return designer.select(
                model,
                learner.at(index),
                belief=learner.belief if belief is None else belief,
                seed=derive_seed(self._state.seed, "design", index),
                **options,
            )

    def _checks(self, index: int) -> bool:
        every = self._state.options.check_every
        return every is not None and (index + 1) % every == 0


def _model_design(
    criticism: Criticism, limits: Limits, exclude: Tensor | None
) -> Design | None:
    """Return the design that tells most about which rival is right.

    Args:
        criticism: Comparison of the model with all trials so far.
        limits: Limits of the actions, and their cost.
        exclude: Actions not to repeat, shape (t, action_dim).

    Returns:
        None if no permitted action tells anything: one rival is left, or those left
        predict the same.
    """
    spent = criticism.rivals.simulator.num_simulations
    found = criticism.next_action(limits.permitted(exclude), beyond=False)
    if found.action is None:
        return None
    candidates = torch.as_tensor(found.candidates).float()
    gain, cost = torch.as_tensor(found.information_gain), limits.price(candidates)
    # Without a cost the choice was made on other simulations than these estimates.
    action = torch.as_tensor(found.action).float()
    index = int((candidates == action).all(1).int().argmax())
    index = index if cost is None else int((gain / cost).argmax())
    unknown = torch.full((len(candidates),), torch.nan, dtype=torch.float64)
    return Design(
        action=candidates[index],
        candidates=candidates,
        expected_information_gain=gain,
        **equal_errors(unknown),
        probability_valid=unknown,
        bound="lower",
        index=index,
        num_simulations=criticism.rivals.simulator.num_simulations - spent,
        **naming(limits.actions),
        estimator="ModelIndexGain",
        stopped="budget spent",
        notes=(f"about which is right: {', '.join(found.separates)}",),
        cost=cost,
    )


def _rests_on_model(design: Design) -> bool:
    """Return whether an estimator uses something learned; unknown ones do."""
    needs = {kind.__name__: kind.needs_model for kind in ESTIMATORS.values()}
    return needs.get(design.estimator, True)


def _utility(design: Design) -> float:
    """Return the chosen action's information by cost, nats a unit of cost."""
    return float(design.utility[design.index])
