"""Ask, tell, update: the one loop behind the command line and the benchmarks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.campaign.checks.health import Health, assess
from sbi_active.campaign.isolation import isolated
from sbi_active.campaign.learner import Learner
from sbi_active.campaign.limits import Limits
from sbi_active.campaign.methods import METHODS, find_method
from sbi_active.campaign.planner import Planner
from sbi_active.campaign.revision import criticize, recompute, revise
from sbi_active.campaign.state import (
    UNSCORED,
    CampaignOptions,
    CampaignState,
    Status,
    Trial,
)
from sbi_active.campaign.telling import find_trial, told_trial
from sbi_active.seeding import derive_seed

if TYPE_CHECKING:
    from sbi_active.criticism import Effect, Report
    from sbi_active.inference.models.posterior import ActionPosterior

__all__ = ["METHODS", "Campaign"]


class Campaign:
    r"""Estimate a simulator's parameters from a few real trials.

    A round: :meth:`ask` for an action, execute it, :meth:`tell` the outcome.
    ``tell`` only records; inference runs in the next ``ask`` or in :meth:`update`.

    Each round trains a network, :attr:`posterior`; what asked it is in
    ``Trial.network_used_by``. With declared noise neither action nor refined belief
    rest on it: notes and diagnostics compare it with them, and refinement also looks
    where it points. With the option ``network="on demand"`` it is trained only when
    something asks.

    Args:
        simulator: ``simulator(theta, action)``, shapes (n, theta_dim) and
            (n, action_dim), giving x of shape (n, *x_shape).
        prior: Over the parameters, with a support.
        actions: What the robot may do.
        method: "asbi", "alhi" (a surrogate likelihood) and "seqbed" (ratios) design
            actions; "nsbi" and "nlhi" are the first two with actions drawn at random.
        effects: What the simulator may lack, see :class:`.Effect`.
            With them, actions are also chosen to tell whether it does.
        cost: Of actions (n, action_dim), shape (n,), positive; or one number an action
            of a list. Actions are then chosen for their information by cost.
        constraint: Which of actions (n, action_dim) the robot may execute now, shape
            (n,), bool. The network learns about the others as well.
        seed: Of everything random; the same seed and outcomes give the same campaign.
        options: Sizes and estimators.

    Raises:
        ValueError: If the method is unknown, the prior has no support, or no width that
            float32 holds, the simulator is deterministic or gives no numbers, or the
            cost or the constraint has another shape.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> from sbi_active import DiscreteActions, MixtureDensity
        >>> prior = BoxUniform(torch.zeros(1), torch.ones(1))
        >>> def simulator(theta, action):
        ...     return theta * action + 0.1 * torch.randn_like(theta)
        >>> options = CampaignOptions(
        ...     num_simulations=500,
        ...     density_estimator=MixtureDensity(num_iterations=50))
        >>> actions = DiscreteActions([0.1, 1.0, 3.0])
        >>> campaign = Campaign(simulator, prior, actions, options=options)
        >>> trial = campaign.ask()
        >>> trial.action
        tensor([3.])
        >>> _ = campaign.tell(torch.tensor([1.5]))
        >>> belief = campaign.update()
    """

    @isolated
    def __init__(
        self,
        simulator: Callable[..., Any],
        prior: Distribution,
        actions: ActionSpace,
        *,
        method: str = "asbi",
        effects: Sequence[Effect] = (),
        cost: Callable[[Tensor], Tensor] | Tensor | None = None,
        constraint: Callable[[Tensor], Tensor] | None = None,
        seed: int = 0,
        options: CampaignOptions | None = None,
    ) -> None:
        find_method(method)  # an unknown name is an error here
        self.actions = actions
        options = CampaignOptions() if options is None else options
        self.state = CampaignState(method=method, seed=seed, options=options)
        self._learner = Learner(simulator, prior, actions, self.state)
        limits = Limits(actions, constraint, cost)
        self._planner = Planner(limits, self.state, effects)

    def __repr__(self) -> str:
        done, pending = len(self.history), self.pending is not None
        return (
            f"Campaign({self.state.method}, {done} trials"
            f"{', one pending' if pending else ''})"
        )

    @property
    def belief(self) -> Distribution:
        """The belief after the trials in ``state.processed``; the prior before any.

        A trial that nothing in the prior explains, as after a slip of the unit, is left
        out of it: five times the range of all simulations from the prior beyond them,
        the model's word would be an extrapolation that pushes the belief to an edge.
        ``belief.diagnostics.trustworthy`` is then False and ``warnings`` names
        the trial, until it is told again or withdrawn. Trials that are beyond all
        simulations but nearer stay in the belief and are named as well.
        """
        return self._learner.stated_belief

    @property
    @isolated
    def posterior(self) -> ActionPosterior:
        r"""The amortized posterior :math:`q(\theta | x, \xi)` under the current belief.

        For any outcome at any action in milliseconds: what a trial would tell, before
        it is run. It is this round's network, trained here where it was not yet; ahead
        of :meth:`ask` that is on no trial's account. The methods "asbi" and "nsbi" have
        one; for others this is a ValueError.
        """
        index = len(self.state.trials) if self.pending is None else self.pending.index
        return self._learner.posterior(index)

    @property
    def simulator(self) -> Callable[..., Any]:
        """The current simulator, with the effects that were adopted."""
        return self._learner.simulator

    @simulator.setter
    def simulator(self, simulator: Callable[..., Any]) -> None:
        self._learner.simulator = simulator

    @property
    def prior(self) -> Distribution:
        """The original prior, times those of the effects that were adopted."""
        return self._learner.prior

    @property
    def effects(self) -> Sequence[Effect]:
        """What the simulator may lack, as the campaign was told."""
        return self._planner.effects

    @property
    def health(self) -> Health:
        """Whether the simulator still explains the trials that the belief contains.

        While it is right, an "alarm" comes in at most 5 % of campaigns, however long
        they are, and a "watch" now and then. Under an alarm the belief may be narrow
        and wrong: do :meth:`criticize`.
        """
        return assess(self.state)

    @property
    def history(self) -> Sequence[Trial]:
        """The trials that were told, in order."""
        return tuple(t for t in self.state.trials if t.status != "pending")

    @property
    def pending(self) -> Trial | None:
        """The trial that was asked for and not told yet."""
        waiting = [t for t in self.state.trials if t.status == "pending"]
        return waiting[0] if waiting else None

    @property
    def stop_reason(self) -> str | None:
        """Why ``options.stop`` says to stop, after the trials the belief contains.

        None while the health is not "ok": a confident wrong belief would stop first.
        """
        if self.health != "ok":
            return None
        design = None if self.pending is None else self.pending.design
        return self.state.options.stop.reason(
            self.belief, design, seed=derive_seed(self.state.seed, len(self.history))
        )

    @isolated
    def ask(self, *, target: str | Sequence[str] = "auto") -> Trial:
        """Return the pending trial, or design the next one.

        Args:
            target: What it should tell most about: "theta", names of parameters, or
                "model", whether the simulator lacks one of the campaign's effects and
                which. "auto" is "theta" without effects; with them it is the one of
                which the best action tells more, in nats, and under an alarm "model".

        Returns:
            The trial; execute ``trial.action``.

        Raises:
            ValueError: If the method draws its actions at random and the target is
                another one, or "model" is asked for without effects or with fewer than
                two trials.
        """
        if self.pending is not None:
            return self.pending
        self._planner.require(target)
        self.update()
        index = len(self.state.trials)
        self.state.trials.append(Trial(index, torch.empty(0)))
        try:
            design, purpose = self._planner.design(
                index, target, self._learner, alarmed=self.health == "alarm"
            )
            what = {"action": design.action, "design": design, "target": purpose}
            self.state.account(
                index, design.num_simulations, design.num_missing, **what
            )
        except BaseException:
            self.state.trials.pop()
            raise
        return self.state.trials[index]

    @isolated
    def tell(
        self,
        x: Tensor | np.ndarray | float | Sequence[float] | None = None,
        *,
        trial: Trial | int | None = None,
        action: Tensor | np.ndarray | Sequence[float] | None = None,
        status: Status = "ok",
    ) -> Trial:
        """Record the outcome of a trial and return at once.

        A trial can be told again: with ``trial=``, another outcome takes the place of
        the recorded one, and the next :meth:`update` computes everything again, beliefs
        and scores of the later trials too, as if it had been told at once. Trials
        behind an adoption are then given to the current model anew, and no longer have
        scores under the models before it.

        Args:
            x: The outcome, shape x_shape; NaN throughout makes the trial "invalid", NaN
                in part of it says that these numbers were not observed, which tells
                nothing by itself. Infinite numbers count as NaN, with a warning.
            trial: The trial or its index; None is the pending one, or a new trial
                where none is pending and ``action`` is given.
            action: The executed action where it is not the one asked for.
            status: "ok", "invalid" (it ran and gave no measurement, which tells about
                the parameters) or "missing" (a fault unrelated to them).

        Returns:
            The recorded trial. Telling the same outcome again changes nothing, with
            ``trial=`` or, for the last trial while none is pending, without.

        Raises:
            ValueError: If there is no such trial, shapes do not fit, the action is not
                finite, or what was told are no real numbers that float32 holds.
        """
        told = told_trial(
            self.state,
            x,
            trial=trial,
            action=action,
            status=status,
            x_shape=self._learner.x_shape,
            actions=self.actions,
        )
        if any(told is known for known in self.state.trials):
            return told
        return self.state.record(told)

    def withdraw(self, trial: Trial | int, *, reason: str = "") -> Trial:
        """Take a trial out; it stays in the history, with the status "withdrawn".

        The next :meth:`update` computes everything again without it, as if it had been
        "missing". :meth:`tell` with ``trial=`` brings it back.

        Args:
            trial: The trial or its index, a pending one too.
            reason: Kept with the trial.

        Returns:
            The recorded trial.

        Raises:
            ValueError: If there is no such trial.
        """
        found = find_trial(self.state, trial)
        changes: dict[str, Any] = {"status": "withdrawn", "reason": reason}
        return self.state.record(replace(found, **changes, **UNSCORED))

    @isolated
    def update(self) -> Distribution:
        """Bring the belief up to date with every trial told so far, and return it."""
        if self.state.is_stale:
            recompute(self.state, self._learner)
        for trial in self.history:
            if trial.index in self.state.processed:
                continue
            if trial.is_measured:
                if trial.version != self.state.version.number:
                    self._learner.score(trial)
                self._learner.learn(self.state.trials[trial.index])
            self.state.processed.append(trial.index)
        return self.belief

    def run(
        self,
        real_system: Callable[[Tensor], Any],
        *,
        num_rounds: int,
        on_round: Callable[[Trial], None] | None = None,
    ) -> Distribution:
        """Run rounds on a real system that can be called.

        It ends early where :attr:`stop_reason` gives one; a trial that was designed by
        then stays pending.

        An exception of the real system passes through; the trial stays pending, and
        the next ``run`` goes on with it.

        Args:
            real_system: Takes an action, shape (action_dim,), and gives x.
            num_rounds: Trials to run.
            on_round: Called with each trial once the belief contains it.

        Returns:
            The belief after the last trial.
        """
        for _ in range(num_rounds):
            if self.stop_reason is not None:
                break
            index = self.ask().index
            if self.stop_reason is not None:
                break
            action = self.state.trials[index].action.clone()
            self.tell(real_system(action), trial=index)
            self.update()
            if on_round is not None:
                on_round(self.state.trials[index])
        return self.belief

    @isolated
    def criticize(
        self, effects: Sequence[Effect] | None = None, *, evaluate: bool = True
    ) -> Report:
        """Compare the current simulator with all trials so far.

        Args:
            effects: What the simulator may lack, None takes the campaign's; those
                already adopted are left out. The first library of a model counts as
                frozen: with another one, or other priors, the report is "exploratory".
            evaluate: As in :func:`.close_loop`.

        Returns:
            The report; :meth:`adopt` takes it.

        Raises:
            ValueError: If fewer than two trials gave a measurement, or the effects do
                not fit.
        """
        self.update()
        return criticize(
            self.state,
            self._planner.compare(self._learner, self.state.measured, effects),
            evaluate=evaluate,
            designed=find_method(self.state.method).designs,
        )

    @isolated
    def adopt(self, report: Report) -> Distribution:
        """Go on with the augmented simulator of a report.

        All trials are inferred again, from the original prior times those of the
        effects. A pending trial stays; surprises and health start anew.

        Args:
            report: Of :meth:`criticize`, whose verdict names effects.

        Returns:
            The belief over (theta, phi).

        Raises:
            ValueError: If the verdict names none, or the report belongs to another
                model than the current one.
        """
        self.update()
        self._learner = revise(self.state, self.actions, report)
        return self.belief
