"""The choice of the next trial, for the parameters or for the right model."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from sbi_active.actions import ActionSpace, DiscreteActions
from sbi_active.arrays import distance_from
from sbi_active.campaign.learning.learner import Learner
from sbi_active.campaign.learning.methods import find_method
from sbi_active.campaign.learning.pooled import PooledLearner
from sbi_active.campaign.learning.revision import compare
from sbi_active.campaign.state import CampaignState, Trial
from sbi_active.design.design import Design, unknown_errors
from sbi_active.design.designer import InformationGainDesigner
from sbi_active.design.estimators.automatic import ESTIMATORS
from sbi_active.design.limits import Cost, DesignLimits
from sbi_active.design.pairs import first_of_pair
from sbi_active.design.random_designer import RandomDesigner
from sbi_active.design.target import Target, name_of
from sbi_active.seeding import derive_seed

if TYPE_CHECKING:
    from sbi_active.criticism import Criticism, Effect

FEWEST_TRIALS = 2  # that rivals can be compared on


class Planner:
    """Designs the trials of a campaign.

    Args:
        actions: Action space of the campaign.
        state: State of the campaign.
        effects: Effects that its simulator may lack.
        constraint: Function of actions (n, action_dim) that says which are permitted,
            shape (n,), bool; None permits all.
        cost: Cost of actions, see :class:`.Campaign`; None for none.

    Attributes:
        effects: Effects that the simulator may lack.

    Raises:
        ValueError: If constraint or cost has another shape, or permits nothing.
    """

    def __init__(
        self,
        actions: ActionSpace,
        state: CampaignState,
        effects: Sequence[Effect],
        *,
        constraint: Callable[[Tensor], Tensor] | None = None,
        cost: Cost | None = None,
    ) -> None:
        from sbi_active.criticism.effects.effect import (
            require_distinct,
            require_nested,
        )

        require_distinct(effects)
        require_nested(effects)
        self._state, self.effects = state, (*effects,)
        options = state.options
        self._limits = DesignLimits(actions, constraint, cost)
        # A wrong shape is an error here, and not in a later round.
        permitted(self._limits)
        some = _listed_or_drawn(actions, 8)
        self._limits.cost(some)
        replace(self._limits, previous=some[0]).cost(some)
        self._designs = find_method(state.method).designs
        self._make_designer = partial(
            InformationGainDesigner,
            num_samples=options.num_samples,
            estimator=options.estimator,
            eliminate=options.details.eliminate,
            workers=options.workers,
        )
        kind = self._make_designer if self._designs else RandomDesigner
        self._designer: Any = kind(actions)

    @property
    def has_cost(self) -> bool:
        """Whether actions have a cost."""
        return self._limits.price is not None

    def charge(self) -> None:
        """Set the cost of each trial that was told, at the executed action."""
        state, previous = self._state, None
        if not self.has_cost and state.options.stop.budget is None:
            return
        for trial in state.trials:
            if trial.status != "pending":
                cost = replace(self._limits, previous=previous).cost(trial.action[None])
                state.change(trial.index, cost=float(cost))
                previous = trial.action

    def limits(self, *, slack: float = 1e-6) -> DesignLimits:
        """Return the limits of the next trial, by the last one and what is left.

        Args:
            slack: Share of the budget that costs in float32 may be off by in all.
        """
        told = [t.action for t in self._state.trials if t.status != "pending"]
        left, budget = self._state.left, self._state.options.stop.budget
        most = math.inf if left is None or budget is None else left + slack * budget
        return replace(self._limits, previous=told[-1] if told else None, left=most)

    @property
    def spent_up(self) -> str | None:
        """Why no trial can follow, where what is left of a budget affords none."""
        state, limits = self._state, self.limits()
        if state.left is None:
            return None
        waiting = [t.action for t in state.trials if t.status == "pending"]
        values = torch.stack(waiting) if waiting else _listed_or_drawn(limits.actions)
        if bool(limits(values).any()):
            return None
        return (
            f"the budget is spent: the trials cost {state.spent:.4g} of "
            f"{state.options.stop.budget:.4g}, and what is left affords no permitted "
            "action"
        )

    def require(self, target: Target) -> None:
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
            permitted(self._limits),
            trials=trials,
            effects=self.effects if effects is None else effects,
        )

    def design(
        self,
        index: int,
        target: Target,
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
        limits = self.limits()
        free = limits.left == math.inf
        allowed = {"constraint": limits.constraint if free else limits}
        if not self._designs:
            return self._select(index, learner, self._designer, **allowed), "random"
        if target == "auto" and self._checks(index):
            told = [t.action for t in self._state.trials if t.is_measured]
            places = most_unlike(permitted(limits), told)
            designer = RandomDesigner(places)
            return self._select(index, learner, designer), "check"
        # What nothing explains would draw the next trial after it; reports have it.
        trials, about_model = self._state.explained, None
        can_compare = self.effects and len(trials) >= FEWEST_TRIALS
        if target == "model" or target == "auto" and can_compare:
            with self._state.stage(index, "criticism"):
                about_model = _model_design(self.compare(learner, trials), limits)
        if about_model is not None and (target == "model" or alarmed):
            return about_model, "model"
        own = "theta" if target in ("auto", "model") else target
        if isinstance(learner, PooledLearner):
            if callable(own):
                raise ValueError(
                    "expected target 'theta' with max_simulations or a SummaryAction, "
                    f"whose pool tells of all parameters; got {name_of(own)!r}; leave "
                    "out target=, or max_simulations="
                )
            design, own = learner.design(index, limits), "theta"
        else:
            model = learner.round.model(index)
            about: Any = {"target": own, "cost": limits.price}
            chosen = index, learner, self._designer, model
            design = self._select(*chosen, **about, **allowed)
            if limits.is_sequential and self._state.options.details.look_ahead > 1:
                design = self._with_next(design, limits, index, learner, model, own)
        if about_model is not None:  # nats a unit of cost
            gains = [float(d.utility[d.index]) for d in (about_model, design)]
            if gains[0] > gains[1]:
                return about_model, "model"
        return design, name_of(own)

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

    def _with_next(
        self,
        design: Design,
        limits: DesignLimits,
        index: int,
        learner: Learner,
        model: Any,
        target: Target,
    ) -> Design:
        """Return the design of a trial that is planned together with the one after."""
        needs = {kind.__name__: kind.needs_model for kind in ESTIMATORS.values()}
        if needs.get(design.estimator) and not hasattr(model, "log_likelihood"):
            note = f"planned alone: {design.estimator} has no joint information"
            return replace(design, notes=(*design.notes, note))

        def beyond(first: Tensor, places: Tensor) -> Design:
            designer = self._make_designer(DiscreteActions(places))
            known = {"target": target, "pending": first}
            return self._select(index, learner, designer, model, **known)

        return first_of_pair(design, limits, beyond)

    def _checks(self, index: int) -> bool:
        every = self._state.options.check_every
        return every is not None and (index + 1) % every == 0


def permitted(limits: DesignLimits) -> ActionSpace:
    """Return the space, where it is limited as a list of what is permitted.

    Raises:
        ValueError: If nothing is permitted.
    """
    actions = limits.actions
    if limits.constraint is None and limits.left == math.inf:
        return actions
    values, _ = limits.listed()
    if values is None:
        values = limits.drawn(0)
    return DiscreteActions(values, names=actions.names, units=actions.units)


def _listed_or_drawn(actions: ActionSpace, num_draws: int = 1_024) -> Tensor:
    """Return the actions of a list, or draws of a space without end."""
    values = actions.listed()
    return actions.sample((num_draws,), seed=0) if values is None else values


def most_unlike(actions: ActionSpace, executed: Sequence[Tensor]) -> ActionSpace:
    r"""Return the permitted actions farthest from all executed ones.

    .. math::
        \arg\max_\xi \min_t \lVert (\xi - \xi_t) / r \rVert

    with r the range of each entry. Actions of most information about d parameters tend
    to repeat about d settings, at which any model of d parameters fits.

    Args:
        actions: The permitted ones.
        executed: Executed actions, each of shape (action_dim,).

    References:
        Johnson, Moore & Ylvisaker, J. Stat. Plan. Inference 1990 (maximin distance).

    Example:
        >>> speeds = DiscreteActions([0.0, 1.0, 2.0, 3.0, 4.0])
        >>> most_unlike(speeds, [torch.tensor([0.0]), torch.tensor([4.0])]).values
        tensor([[2.]])
    """
    if not executed:
        return actions
    values = _listed_or_drawn(actions)
    distance = distance_from(torch.stack([*executed]), values)
    best = distance >= distance.max() - 1e-6
    return DiscreteActions(values[best], names=actions.names, units=actions.units)


def _model_design(criticism: Criticism, limits: DesignLimits) -> Design | None:
    """Return the design that tells most about which rival is right.

    Args:
        criticism: Comparison of the model with all trials so far.
        limits: Limits of the actions, and their cost.

    Returns:
        None if no permitted action tells anything: one rival is left, or those left
        predict the same.
    """
    spent = criticism.rivals.simulator.num_simulations
    found = criticism.next_action(permitted(limits), beyond=False)
    if found.action is None:
        return None
    candidates = torch.as_tensor(found.candidates).float()
    gain = torch.as_tensor(found.information_gain)
    cost = None if limits.price is None else limits.price(candidates)
    # Without a cost the choice was made on other simulations than these estimates.
    action = torch.as_tensor(found.action).float()
    index = int((candidates == action).all(1).int().argmax())
    index = index if cost is None else int((gain / cost).argmax())
    return Design(
        action=candidates[index],
        candidates=candidates,
        expected_information_gain=gain,
        **unknown_errors(len(candidates)),
        bound="lower",
        index=index,
        num_simulations=criticism.rivals.simulator.num_simulations - spent,
        labels=limits.actions.entry_labels,
        estimator="ModelIndexGain",
        stopped="budget spent",
        notes=(f"about which is right: {', '.join(found.separates)}",),
        cost=cost,
    )
