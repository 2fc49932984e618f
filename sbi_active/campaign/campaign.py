"""Ask, tell, update: the one loop behind the command line and the benchmarks."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions.discrete import Actions, action_space
from sbi_active.campaign.isolation import guarded, isolated
from sbi_active.campaign.learning.methods import find_method
from sbi_active.campaign.learning.planner import Planner
from sbi_active.campaign.learning.pooled import make_learner
from sbi_active.campaign.learning.revision import recompute, revise
from sbi_active.campaign.options import CampaignOptions
from sbi_active.campaign.state import CampaignState, Trial
from sbi_active.campaign.storage.directory import (
    Storage,
    facts_of,
    load,
    make_campaign,
    stored,
)
from sbi_active.campaign.trials import CampaignTrials
from sbi_active.design.limits import Cost
from sbi_active.design.target import Target
from sbi_active.expected import suggests
from sbi_active.simulation.workers.store import SimulationBudgetError, metering

if TYPE_CHECKING:
    from sbi_active.criticism import Effect, Report
    from sbi_active.inference.models.posterior import ActionPosterior


class Campaign(CampaignTrials):
    r"""Estimate a simulator's parameters from a few real trials.

    A round: :meth:`ask` for an action, execute it, :meth:`tell` the outcome.
    ``tell`` only records; inference runs in the next ``ask`` or in :meth:`update`.

    Each round trains a network, :attr:`posterior`. With declared noise neither the
    action nor the refined belief depends on it: notes and diagnostics compare it with
    them, and the refinement also searches where it points. With the option
    ``network="on demand"`` it is trained only when needed.

    Args:
        simulator: ``simulator(theta, action)``, shapes (n, theta_dim) and
            (n, action_dim), giving x of shape (n, *x_shape).
        prior: Prior of the parameters, with a support.
        actions: Actions that the robot may take: a space, or a list of actions.
        method: "asbi", "alhi" (a surrogate likelihood) and "seqbed" (ratios) design
            actions; "nsbi" and "nlhi" are the first two with actions drawn at random.
        effects: Effects that the simulator may lack, see :class:`.Effect`. With them,
            actions are also chosen to test for these effects.
        cost: Cost of actions (n, action_dim), shape (n,), positive; or one number an
            action of a list. Actions are then chosen for their information by cost.
            ``cost(action, previous)`` also takes the action executed before, shape
            (action_dim,), None for the first. ``StopRules(budget=)`` limits the total.
        constraint: Function of actions (n, action_dim) that says which may be executed
            now, shape (n,), bool. The network learns about the others as well.
        seed: Seed of all draws; the same seed and outcomes give the same campaign.
        options: Sizes and estimators; or fields of them in a dict.
        directory: New or empty folder, to which the campaign is written as it runs, so
            that :meth:`load` can resume it after a crash. None keeps it in memory
            alone.
        show_progress: Whether to draw a bar of what is being done, and of the rounds of
            :meth:`run`. The logger "sbi_active" reports all that takes 2 s anyway.

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

    @suggests
    @isolated
    def __init__(
        self,
        simulator: Callable[..., Any],
        prior: Distribution,
        actions: Actions,
        *,
        method: str = "asbi",
        effects: Sequence[Effect] = (),
        cost: Cost | None = None,
        constraint: Callable[[Tensor], Tensor] | None = None,
        seed: int = 0,
        options: CampaignOptions | Mapping[str, Any] | None = None,
        directory: str | os.PathLike[str] | None = None,
        show_progress: bool = False,
    ) -> None:
        find_method(method)  # an unknown name is an error here
        actions, options = action_space(actions), CampaignOptions.of(options)
        state = CampaignState(method, seed, options)
        with metering(state.meter):
            learner = make_learner(simulator, prior, actions, state)
        limits = {"cost": cost, "constraint": constraint}
        planner = Planner(actions, state, effects, **limits)
        folder = None if directory is None else Path(directory)
        if folder is not None:
            given = {"prior": prior, "actions": actions, "options": options}
            facts = facts_of(state, simulator)
            facts["limits"] = [n for n in limits if limits[n] is not None]
            facts["effects"] = [effect.name for effect in effects]
            facts["x_shape"] = [*learner.x_shape]
            make_campaign(folder, given, facts)
        self._begin(learner, planner, Storage(folder, prior=prior), show_progress)

    def _begin(
        self, learner: Any, planner: Planner, storage: Storage, show_progress: bool
    ) -> None:
        self._guard = threading.RLock()
        self.state, self.actions = learner.state, learner.actions
        self._learner, self._planner, self._storage = learner, planner, storage
        self.state.show_progress = show_progress
        self._charge()

    @classmethod
    @suggests
    @isolated
    def load(
        cls,
        directory: str | os.PathLike[str],
        *,
        simulator: Callable[..., Any] | None = None,
        prior: Distribution | None = None,
        actions: Actions | None = None,
        effects: Sequence[Effect] = (),
        cost: Cost | None = None,
        constraint: Callable[[Tensor], Tensor] | None = None,
        options: CampaignOptions | Mapping[str, Any] | None = None,
        show_progress: bool = False,
        simulator_changed: bool = False,
    ) -> Campaign:
        """Return the campaign in a directory, where it was left or killed.

        It continues with the same actions, outcomes and beliefs, to the last bit.
        Nothing in the directory is executed.

        Args:
            directory: Directory of the campaign, as given to the constructor.
            simulator: Simulator that the campaign was made with. Without it the
                campaign can be read, told and corrected, and neither :meth:`ask` nor
                :meth:`update` compute.
            prior: Prior of the parameters, needed if it is of your own class; else
                None takes the directory's.
            actions: Action space, likewise.
            effects: Effects given to the constructor, and those that were adopted
                since: functions are not stored.
            cost: Cost of actions, as given to the constructor.
            constraint: Constraint of actions, likewise.
            options: Options as in the constructor, needed if an estimator is of your
                own class; None takes the directory's. Changed options hold for this
                process, with a warning.
            show_progress: Whether to draw a progress bar.
            simulator_changed: Whether to take another simulator than the campaign was
                made with, and compute everything again with it.

        Raises:
            ValueError: If there is no campaign, or one of another simulator or schema.
            CorruptSegmentError: If a file does not hold what was written.
        """
        given = {
            "prior": prior,
            "actions": None if actions is None else action_space(actions),
            "options": None if options is None else CampaignOptions.of(options),
        }
        limits: Any = {"cost": cost, "constraint": constraint}
        storage = Storage(Path(directory))
        learner = load(
            storage,
            simulator,
            given=given,
            effects=effects,
            limits=[n for n in limits if limits[n] is not None],
            simulator_changed=simulator_changed,
        )
        lacked = [e for e in effects if e.name in storage.manifest["effects"]]
        planner = Planner(learner.actions, learner.state, lacked, **limits)
        self = cls.__new__(cls)
        self._begin(learner, planner, storage, show_progress)
        return self

    @guarded
    def close(self) -> None:
        """Let other processes write to the directory until the next call."""
        self._storage.close()

    def __enter__(self) -> Campaign:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        # A copy is in memory alone: a directory belongs to one campaign.
        own = {**vars(self), "_storage": Storage(prior=self.first_prior)}
        return {name: part for name, part in own.items() if name != "_guard"}

    def __setstate__(self, own: dict[str, Any]) -> None:
        vars(self).update(own, _guard=threading.RLock())

    @property
    @stored
    def posterior(self) -> ActionPosterior:
        r"""The amortized posterior :math:`q(\theta | x, \xi)` under the current belief.

        It gives the posterior of any outcome at any action in milliseconds, before a
        trial is run. It is this round's network, which is trained here if it was not
        yet. Only the methods "asbi" and "nsbi" have one; others raise a ValueError.
        """
        index = len(self.state.trials) if self.pending is None else self.pending.index
        return self._learner.round.posterior(index)

    @stored
    def ask(self, *, target: Target = "auto") -> Trial:
        """Return the pending trial, or design the next one.

        No action costs more than what is left of the budget. With a cost that depends
        on the trial before, the next two are planned together (``look_ahead``).

        Args:
            target: Target of the design: "theta", names or a function of parameters
                as in :meth:`.InformationGainDesigner.select`, or "model", whether the
                simulator lacks one of the campaign's effects and which.
                "auto" is "theta" without effects; with them it is the one of which the
                best action tells more, in nats, and under an alarm "model".

        Returns:
            The trial; execute ``trial.action``.

        Raises:
            ValueError: If the method draws its actions at random and the target is
                another one, "model" is asked for without effects or with fewer than
                two trials, or what is left of the budget affords no action.
        """
        if self.pending is not None:
            return self.pending
        self._planner.require(target)
        self.update()
        if self.state.used_up is not None:
            raise SimulationBudgetError(
                f"{self.state.used_up}. Load the campaign with a larger "
                "max_simulations to go on"
            )
        if (reason := self._planner.spent_up) is not None:
            raise ValueError(f"{reason}. Load the campaign with a larger budget")
        index = len(self.state.trials)
        self.state.trials.append(Trial(index, torch.empty(0)))
        try:
            design, purpose = self._planner.design(
                index, target, self._learner, alarmed=self.health == "alarm"
            )
            what = {"action": design.action, "design": design, "target": purpose}
            spent = design.num_simulations, design.num_missing
            self.state.account(index, *spent, **what)
        except BaseException:
            self.state.trials.pop()
            raise
        self._storage.write("asked", self.state.trials[index])
        self._storage.save(self.state, self._learner)
        return self.state.trials[index]

    @stored
    def update(self) -> Distribution:
        """Bring the belief up to date with every trial told so far, and return it."""
        state, learner = self.state, self._learner
        _ = learner.belief  # one that cannot be read has all computed again
        if state.is_stale:
            recompute(state, learner)
            self._storage.save(state, learner)
        for trial in [t for t in self.history if t.index not in state.processed]:
            if trial.is_measured and not learner.takes(trial):
                break
            state.processed.append(trial.index)
            state.change(trial.index, health=self.health)
            if trial.is_measured:
                state.keep_draws(learner.belief)
            self._storage.save(state, learner)
        return self.belief

    def run(
        self,
        real_system: Callable[[Tensor], Any],
        *,
        num_rounds: int,
        on_round: Callable[[Trial], None] | None = None,
    ) -> Distribution:
        """Run rounds on a real system that can be called.

        It ends early if there is a :attr:`stop_reason`; a trial that was designed by
        then stays pending, as it does after an exception of the real system.

        Args:
            real_system: Function that takes an action, shape (action_dim,), and gives
                x.
            num_rounds: Trials to run beyond those told before; a pending one is first.
            on_round: Function that is called with each trial once the belief contains
                it.

        Returns:
            The belief after the last trial.
        """
        from tqdm.auto import tqdm

        hidden = not self.state.show_progress
        for _ in tqdm(range(num_rounds), desc="rounds", disable=hidden):
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

    @stored
    def criticize(
        self, effects: Sequence[Effect] | None = None, *, evaluate: bool = True
    ) -> Report:
        """Compare the current simulator with all trials so far.

        Args:
            effects: Effects that the simulator may lack; None takes the campaign's;
                those already adopted are left out. After the first library of a model,
                another one, or other priors, make the report "exploratory".
            evaluate: Whether to report the error before and after, see
                :func:`.close_loop`.

        Returns:
            The report; :meth:`adopt` takes it.

        Raises:
            ValueError: If fewer than two trials gave a measurement, or the effects do
                not fit.
        """
        self.update()
        state = self.state
        criticism = self._planner.compare(self._learner, state.measured, effects)
        earlier = state.version.examined
        with state.watched(len(state.trials), "criticism"):
            report = criticism.report(
                evaluate=evaluate,
                designed=find_method(state.method).designs,
                exploratory=any(digest != criticism.digest for digest in earlier),
            )
        state.examined(criticism.digest)
        found: Any = {"digest": report.digest, "verdict": report.verdict}
        self._storage.write("examined", **found, chosen=[*report.tracing.chosen])
        return report

    @stored
    def adopt(self, report: Report) -> Distribution:
        """Go on with the augmented simulator of a report.

        All trials are inferred again, from the original prior times those of the
        effects. A pending trial stays; surprises and health start anew.

        Args:
            report: Report of :meth:`criticize`, whose verdict names effects.

        Returns:
            The belief over (theta, phi).

        Raises:
            ValueError: If the verdict names none, or is of another model.
        """
        self.update()
        self._learner = revise(self.state, self.actions, report)
        self._storage.write("adopted", version=asdict(self.state.version))
        self._storage.save(self.state, self._learner)
        return self.belief
