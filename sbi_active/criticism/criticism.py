"""The closed loop step by step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.actions.discrete import Actions, action_space
from sbi_active.criticism.checks import (
    digest,
    require_classes,
    require_fitting,
    require_warm_up,
    with_noise,
)
from sbi_active.criticism.contradictions import OutlyingTrial
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.augmented import AugmentedSimulator
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.effects.joint_prior import joint_prior
from sbi_active.criticism.effects.trial_conditions import with_known_inputs
from sbi_active.criticism.linear.screening import (
    Sampling,
    linear_models,
    thinned_to_need,
)
from sbi_active.criticism.misfit.contrary import judged
from sbi_active.criticism.misfit.evaluation import evaluate_held_out, evaluate_left_out
from sbi_active.criticism.misfit.record import traced
from sbi_active.criticism.misfit.rule import Rule
from sbi_active.criticism.misfit.verdict import Verdict, judge
from sbi_active.criticism.next_action import choose_action, severe_tests
from sbi_active.criticism.report.report import Report
from sbi_active.criticism.report.words import blocks
from sbi_active.criticism.results import (
    NONE,
    Detection,
    Evaluation,
    NextAction,
    Residuals,
    Tracing,
)
from sbi_active.criticism.rivals.rival_set import RivalSet
from sbi_active.criticism.steps.equivalence import equivalent_effects, is_large
from sbi_active.criticism.steps.predictive import NUM_DRAWS, find_residuals
from sbi_active.expected import require, suggests
from sbi_active.progress import stage
from sbi_active.simulation import SimulatorModel

FEWEST_TRIALS = 4  # to leave one out
#: Posterior draws that predict held-out trials, of models by linear evidence.
FEW_DRAWS = 60


class Criticism:
    r"""Compares a simulator with measured trials, step by step.

    Each step is computed once and kept. Held-out trials are used by :meth:`evaluate`
    alone.

    Args:
        model: The simulator, with its measurement noise. A random one without noise is
            the draw itself, and has a synthetic likelihood; the noise of a
            deterministic one without is estimated from repeated trials.
        prior: Prior of its parameters.
        trials: Measured trials.
        effects: Effects that the simulator may lack. Those of the order of the trials
            are left out if the order is unknown.
        actions: Permitted actions; None takes those of the trials.
        warm_up: Time from its first sample, in the unit of the sample times, in which a
            held-out or left-out trial tells of its nuisances (effects of scope
            "trial"), and is not scored; 0 draws them from their priors.
        thin: Whether to thin trajectories to a rate at which innovations of the bare
            model's fit are uncorrelated, if ``measurement_sd`` declares the sensor's
            error.
        rule: Rule of what helps and what is named if every model misses.
        seed: Seed of all draws.
        show_progress: Whether to draw a progress bar.

    Raises:
        ValueError: If fewer than two trials can be fitted, shapes differ, an effect
            does not vanish at its null or is named like a catch-all, or the simulator
            is random and declares noise besides.

    Example:
        >>> import torch
        >>> from sbi.utils import BoxUniform
        >>> from torch.distributions import Normal
        >>> from sbi_active import GaussianNoise, SimulatorModel
        >>> noise = GaussianNoise(0.1)
        >>> model = SimulatorModel(lambda theta, xi: theta * xi, noise=noise)
        >>> bias = Effect(
        ...     "bias", hook="observation", prior=Normal(0.0, 1.0), null=0.0,
        ...     apply=lambda x, phi, action, context: x + phi,
        ... )
        >>> action = torch.linspace(-1, 1, 6)[:, None]
        >>> trials = Trials(action, 2 * action + 1)
        >>> prior = BoxUniform(-5 * torch.ones(1), 5 * torch.ones(1))
        >>> Criticism(model, prior, trials, effects=[bias]).trace().verdict
        'bias'
    """

    @suggests
    def __init__(
        self,
        model: SimulatorModel,
        prior: Distribution,
        trials: Trials,
        *,
        effects: Sequence[Effect] = (),
        actions: Actions | None = None,
        warm_up: float = 0.0,
        thin: bool = True,
        rule: Rule = Rule(),  # noqa: B008  (frozen)
        seed: int = 0,
        show_progress: bool = False,
    ) -> None:
        require_classes(model, prior, trials, effects)
        self.show_progress, self.rule = show_progress, rule
        model = with_noise(model, prior, trials)
        actions = None if actions is None else action_space(actions)
        self.model, self.prior, self.seed = model, prior, seed
        unordered = trials.order == "unknown"
        #: Effects of the order of the trials where that is unknown.
        self.left_out = [e.name for e in effects if unordered and e.needs_order]
        self.effects = [e for e in effects if e.name not in self.left_out]
        require_fitting(model, prior, trials, self.effects, actions)
        if actions is not None:
            actions = with_known_inputs(model, trials.fit, actions)
        self.actions, self.trials = actions, trials
        #: Sampling of the trajectories; None if not looked for.
        self.sampling: Sampling | None = None
        self._warm_up = require_warm_up(warm_up, trials, self.effects)
        #: Trials that every model misses by far more than the others.
        self.set_aside: tuple[OutlyingTrial, ...] = ()
        self._look(thins=thin)
        #: Hash of the noise, the effects and all priors, as they were declared.
        self.digest = digest(model, prior, self.effects)

    def _look(self, *, thins: bool) -> None:
        """Make the models of the trials that are there."""
        with stage("a look at the simulator", show_progress=self.show_progress):
            rivals = self._models()
            if thins:
                self.trials, self.sampling = thinned_to_need(rivals, self.trials)
                if self.sampling is not None and self.sampling.every > 1:
                    rivals = self._models()
            #: Effects that linear evidence set aside; None where all are fitted.
            self._search, self.screening = linear_models(rivals)
        self._is_large = is_large(rivals.library)
        self._equivalent: tuple[frozenset[str], ...] | None = None

    def _models(self) -> RivalSet:
        own = self.model, self.prior, self.trials.fit, self.effects
        options = {"actions": self.actions, "warm_up": self._warm_up}
        return RivalSet(*own, seed=self.seed, **options)

    @cached_property
    def _verdict(self) -> Verdict:
        """What the models say, without trials that are not to decide it."""
        while True:
            groups = self.equivalent()
            with stage("models fitted", show_progress=self.show_progress):
                found = judge(self._search, groups, self.rule)
            asks = found.is_missed and not self.set_aside
            if not asks or not (outlying := found.outlying()):
                return found
            self.set_aside = outlying
            self.trials = _without(self.trials, outlying)
            self._look(thins=False)

    @property
    def rivals(self) -> RivalSet:
        """The models; once traced with the posteriors of those that are recorded."""
        return self._traced[1] if "_traced" in vars(self) else self._search.rivals

    def residuals(self) -> Residuals:
        """Return the residuals of the bare model."""
        return self._residuals

    @cached_property
    def _residuals(self) -> Residuals:
        self.trace()  # by which models have their posteriors
        return find_residuals(self.rivals)

    def equivalent(self) -> tuple[frozenset[str], ...]:
        """Return groups of effects that no permitted action separates.

        It depends on the simulator and the actions, not on what was measured; without
        permitted actions, on those of the trials.
        """
        if self._is_large:  # the next action looks for what separates them
            return ()
        if self._equivalent is None:
            with stage("effects told apart", show_progress=self.show_progress):
                self._equivalent = equivalent_effects(self._search.rivals, self.actions)
        return self._equivalent

    def detect(self) -> Detection:
        """Return whether the bare model misses the data."""
        return self._verdict.detection

    def trace(self) -> Tracing:
        """Return the tracing: the effect that the data point to."""
        return self._traced[0]

    @cached_property
    def _traced(self) -> tuple[Tracing, RivalSet]:
        found = self._verdict
        # Each model's held-out errors would take as much as the verdict.
        held_out = None if self._is_large else self.trials.held_out
        with stage("verdict, sets of effects fitted", show_progress=self.show_progress):
            tracing, models = traced(found, held_out)
        return replace(tracing, set_aside=self.set_aside), models

    def add(
        self, effects: Sequence[str] | None = None
    ) -> tuple[SimulatorModel, Distribution]:
        """Return the simulator with effects added, and its prior.

        Args:
            effects: Names; None takes those of the verdict.

        Returns:
            The augmented simulator, whose parameters are (theta, phi), and their prior.
            Without effects, the bare simulator and its prior.
        """
        names = self.trace().chosen if effects is None else (*effects,)
        known = self._search.rivals
        lost, advice = {*names} - {e.name for e in known.library}, "declare them"
        expected = f"effects among {', '.join(known.effects) or 'none'}"
        require(not lost, expected, ", ".join(sorted(lost)), advice)
        declared = {e.name: e for e in self.effects}
        every = (*names, *[e.name for e in known.nuisances])
        if not (added := [declared[n] for n in every]):
            return self.model, self.prior
        index = int(self.trials.index.max()) + 1
        model = AugmentedSimulator(self.model, added, next_index=index)
        return model, joint_prior(self.prior, added)

    def next_action(
        self, actions: ActionSpace | None = None, *, beyond: bool = True
    ) -> NextAction:
        """Return the action whose outcome tells most about which rival is right.

        Args:
            actions: Permitted actions; None takes those of the constructor.
            beyond: Whether to name one that is not permitted where rivals are
                separated by no other.
        """
        space = self.actions
        if actions is not None:
            space = with_known_inputs(self.model, self.trials.fit, actions)
        if space is None:
            raise ValueError(
                "expected the permitted actions; got None; give "
                "next_action(actions) or Criticism(actions=...)"
            )
        tracing = self.trace()
        with stage("next action", show_progress=self.show_progress):
            return choose_action(self.rivals, tracing, space, outside=beyond)

    def evaluate(self) -> Evaluation | None:
        """Return the error before and after, on held-out trials where there are any.

        Otherwise each trial is predicted by models that were chosen and fitted without
        it; None with fewer than four trials.
        """
        return self._evaluation

    @cached_property
    def _evaluation(self) -> Evaluation | None:
        tracing, trials = self.trace(), self.trials
        options = {"num_draws": FEW_DRAWS if self._is_large else NUM_DRAWS}
        if (held_out := trials.held_out) is not None:
            return evaluate_held_out(self.rivals, tracing, held_out, **options)
        if int(self.trials.valid.sum()) < FEWEST_TRIALS:
            return None
        shown, given = self.show_progress, (self._verdict, self.rivals, trials.fit)
        return evaluate_left_out(*given, show_progress=shown, **options)

    def judged(self, evaluation: Evaluation | None) -> Tracing:
        """Return the tracing, unless trials that had no part in it speak against it.

        Effects that predict these trials worse are withdrawn, and forces of the
        dictionary that leave more than the sensor's error are called stand-ins.

        Args:
            evaluation: The error before and after; None if not requested.
        """
        tracing = self.trace()  # which the posteriors of the models come with
        return judged(self._verdict, self.rivals, tracing, evaluation)

    def report(
        self,
        *,
        evaluate: bool = True,
        plan: bool = True,
        designed: bool = False,
        exploratory: bool = False,
    ) -> Report:
        """Return the report of all steps.

        Args:
            evaluate: Whether to report the error before and after.
            plan: Whether to name the next action and the severest tests of the verdict,
                which takes about as long as the verdict.
            designed: Whether the trials' actions were chosen for their information; the
                report then warns of it.
            exploratory: Whether library or priors were changed after the data were
                seen; the report then warns of it.
        """
        evaluation = self.evaluate() if evaluate else None
        tracing, trials = self.judged(evaluation), self.trials
        is_withdrawn = tracing.refuted is not None or bool(tracing.bounds.replaces)
        if is_withdrawn and evaluation is not None and trials.held_out is not None:
            evaluation = evaluate_held_out(self.rivals, tracing, trials.held_out)
        simulator, prior = self.add(tracing.chosen)
        space, after, tests = self.actions if plan else None, None, ()
        next_action = None if space is None else self.next_action()
        with stage("residuals and tests", show_progress=self.show_progress):
            residuals = self.residuals()
            if tracing.verdict != NONE:
                after = find_residuals(self.rivals, tracing.key)
            if space is not None:
                tests = severe_tests(self.rivals, tracing, space)
        labels = trials.action_labels or (self.actions and self.actions.entry_labels)
        default = [f"action {i + 1}" for i in range(trials.action.shape[1])]
        return Report(
            trials=trials,
            residuals=residuals,
            residuals_after=after,
            detection=self.detect(),
            tracing=tracing,
            simulator=simulator,
            prior=prior,
            evaluation=evaluation,
            next_action=next_action,
            action_labels=labels or default,
            digest=self.digest,
            severe_tests=tests,
            designed=designed,
            exploratory=exploratory,
            notes=(*blocks("notes", compared=self),),
        )


def _without(trials: Trials, outlying: Sequence[OutlyingTrial]) -> Trials:
    """Return all trials but some of those that were fitted."""
    fitted = [k for k, role in enumerate(trials.role) if role == "fit"]
    gone = {fitted[trial.position] for trial in outlying}
    return trials.select([k for k in range(len(trials)) if k not in gone])
