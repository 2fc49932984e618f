"""Choose the next action by expected information gain."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions.discrete import Actions, action_space
from sbi_active.design.design import Design
from sbi_active.design.elimination import GainEvaluator, as_batch
from sbi_active.design.estimators.automatic import by_name, find_estimator
from sbi_active.design.estimators.base import InformationGainEstimator, at_least
from sbi_active.design.estimators.model_index import ModelIndexGain, RivalSampler
from sbi_active.design.given import GivenSampler
from sbi_active.design.limits import DesignLimits
from sbi_active.design.sampler import CandidateSampler
from sbi_active.design.search import GradientSearch, Search
from sbi_active.design.target import Target, target_estimator
from sbi_active.expected import Shown, require, suggests
from sbi_active.messages import warn
from sbi_active.seeding import derive_seed
from sbi_active.simulation import MissingRowsWarning, Simulations
from sbi_active.simulation.workers.settings import IN_PROCESS, Workers


class InformationGainDesigner(Shown):
    r"""Choose :math:`\xi^* = \arg\max_\xi I(\theta; x | \xi) / c(\xi)`.

    A search finds the candidates: all actions of a list; in a continuous or mixed space
    those at which a regression of the gain is largest. They are then simulated at the
    same parameters, so that estimates are compared on common random numbers. Half of
    these simulations choose; the others report, since the largest of many noisy
    estimates is too large. Every candidate first gets half of ``num_samples``. Those
    within some standard errors of the leader then get twice as many again and again,
    until the leader is the best with a probability of .95, or is expected to lose less
    than .05 nat (.003 after a search), or the budget is spent (successive elimination).
    The report has no part in this.

    Args:
        actions: The action space, or a list of actions.
        num_samples: Simulations a candidate on average; an action that stays among the
            leading ones gets at most four times as many. A search of a box spends as
            many as for four candidates, four more each entry, and four more each
            category after the first; half of them on comparing its finalists.
        estimator: Estimator of the information gain; the name of one (see
            :mod:`sbi_active.design`); or "auto". That takes declared noise
            first (entropies by nearest neighbors where x is one number, nested Monte
            Carlo where it is more), then the same with noise from replicates that pass
            a test of normality, else what the model can say.
        search: Search of a space that is no list, of which all actions are compared:
            an object, "gradient", or "auto", which is the same.
        eliminate: Start with half of the samples and spend the rest on the candidates
            still in reach of the leader; without it every candidate gets all of them.
        workers: Workers that run the simulations.
        most_numbers: Number of an outcome's numbers beyond which a few linear summaries
            stand for them, where the noise is declared and Gaussian; the design's notes
            say what these leave out. A tenth is compared as fast, ten times as many
            take ten times as long.

    Raises:
        ValueError: If ``num_samples`` is below 8, or the name of an estimator or a
            search is unknown.
        TypeError: If parts of the space are neither boxes nor lists.

    Example:
        >>> from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel
        >>> prior = torch.distributions.MultivariateNormal(torch.zeros(1), torch.eye(1))
        >>> designer = InformationGainDesigner(
        ...     DiscreteActions([0.1, 1.0, 4.0]), num_samples=400)
        >>> simulator = SimulatorModel(lambda t, a: a * t, noise=GaussianNoise(1.0))
        >>> design = designer.select(None, simulator, belief=prior, seed=0)
        >>> design.action, design.estimator
        (tensor([4.]), 'EntropyGain')

    References:
        Even-Dar, Mannor & Mansour, JMLR 2006 (successive elimination); Kirsch et al.,
        TMLR 2023 (choice in proportion to a power of the utility).
    """

    @suggests
    def __init__(
        self,
        actions: Actions,
        *,
        num_samples: int = 1_500,
        estimator: str | InformationGainEstimator = "auto",
        search: str | Search = "auto",
        eliminate: bool = True,
        workers: Workers = IN_PROCESS,
        most_numbers: float = 200,
    ) -> None:
        self.num_samples = at_least(num_samples, 8, "num_samples", 1_000)
        self.actions = actions = action_space(actions)
        self.estimator, self.eliminate = estimator, eliminate
        found = by_name(search, "search", Search, {"gradient": GradientSearch})
        self.search: Search = found or GradientSearch()
        if actions.listed() is None:
            self.search.size(actions)  # parts that it does not search are an error
        self.workers, self.most_numbers = workers, most_numbers
        find_estimator(estimator)  # an unknown name is an error here

    @suggests
    def select(
        self,
        model: Any,
        simulator: Callable[..., Any] | None = None,
        *,
        belief: Distribution | None = None,
        target: Target = "theta",
        simulations: Simulations | None = None,
        cost: Callable[[Tensor], Tensor] | None = None,
        constraint: Callable[[Tensor], Tensor] | None = None,
        pending: Tensor | None = None,
        min_probability_valid: float = 0.0,
        num_actions: int = 1,
        budget: int | None = None,
        seed: int | None = None,
    ) -> Design:
        """Return the action that tells most about the target, or a batch of them.

        Args:
            model: Model that the estimator needs, for :class:`PosteriorGain` anything
                with ``log_posterior(theta, x, action)``; None if it needs nothing.
                For the target "model" the rivals, a sequence of
                :class:`.RivalPredictive`.
            simulator: ``simulator(theta, action)``; not used for the target "model".
            belief: Distribution of the parameters; None is ``model.belief``.
            target: "theta", all parameters; one or several names of the simulator's
                parameters, the others being nuisances (:class:`.ParameterGain`, or
                :class:`.LinearGain` where the estimator is "linear"); a function of
                the parameters, such as a controller's loss, whose value the action is
                to tell: ``g(theta)``, or ``g(theta, effect)`` with a dict of the
                effects' parameters by name, (n, theta_dim) -> (n,) or (n, k), by the
                same estimators; or "model", the index of the rivals
                (:class:`.ModelIndexGain`). The estimates of ParameterGain and of the
                latter are lower bounds.
            simulations: Rows under the belief, such as those that the model was trained
                on; then nothing is simulated. Half of them choose and half report, but
                where the model has seen them, both are too high.
            cost: Cost of actions (n, action_dim), shape (n,), positive. The utility is
                information by cost.
            constraint: Function of actions (n, action_dim) that says which are
                permitted, shape (n,), bool.
            pending: Actions under way, shape (p, action_dim), whose outcomes will be
                known: what counts is the information beyond them.
            min_probability_valid: Candidates that give a measurement less often, by
                the share of the first simulations, are not chosen; 0 excludes none.
            num_actions: Number of actions of a batch. They are chosen one after the
                other by joint information with those before, each with the budget of
                one. This and ``pending`` take joint outcomes, which estimators by the
                noise ("entropy", "nested"), a likelihood, or named parameters have; a
                posterior or a ratio of single outcomes has not.
            budget: Simulations of an action in all; None is ``num_samples`` a
                candidate.
            seed: Seed of the simulations; None draws one from torch's global generator.

        Returns:
            The design.

        Raises:
            ValueError: If there is no belief, the budget is too small, the simulator is
                deterministic, the estimator needs a model or has no joint information,
                the target is unknown, or no candidate is permitted or valid often
                enough.
        """
        at_least(num_actions, 1, "num_actions", 1)
        dim = self.actions.action_dim
        others = torch.empty(0, dim) if pending is None else pending.reshape(-1, dim)
        limits = DesignLimits(self.actions, constraint, cost, min_probability_valid)
        belief = getattr(model, "belief", None) if belief is None else belief
        seed = int(torch.randint(2**62, ())) if seed is None else seed
        num_others = len(others) + num_actions - 1
        estimator = target_estimator(
            target, self.estimator, model, simulator, belief, simulations, num_others
        )
        learns = estimator is not None and estimator.needs_model
        listed, notes = limits.listed()
        budget = 0 if simulations is not None else self._budget(budget, listed)
        steps: list[Design] = []
        for k in range(num_actions):
            own = derive_seed(seed, "action", k) if k else seed
            if target == "model":
                sampler = RivalSampler(model, own)
                estimator = ModelIndexGain(sampler.probability)
            elif simulations is not None:
                sampler = GivenSampler(simulations, limits)
                listed = sampler.action
            else:
                probed = listed
                if probed is None:
                    probed = self.actions.sample((16,), seed=derive_seed(own, "probed"))
                assert belief is not None
                sampler = CandidateSampler(
                    *(simulator, belief, probed, own, self.workers),
                    # A model was learned from whole outcomes.
                    most_numbers=math.inf if learns else self.most_numbers,
                    replicates=estimator is None or estimator.needs_noise,
                    others=others,
                )
            gains = GainEvaluator(sampler, estimator, model, belief, limits, own)
            finalists = listed
            if finalists is None:
                objective = gains.objective(self.search, budget, self.num_samples)
                finalists = self.search.finalists(objective)
            steps.append(
                gains.eliminate(
                    *(finalists, budget),
                    num_samples=self.num_samples,
                    share=0.5 if self.eliminate else 1.0,
                    negligible=self.search.negligible if listed is None else 0.05,
                    notes=notes,
                )
            )
            others = torch.cat([others, steps[-1].action[None]])
            if isinstance(sampler, GivenSampler):
                steps = [sampler.of_rows(steps[-1])]
        design = as_batch(steps)
        if design.num_missing:
            warn(
                f"SA301 {design.num_missing} of {design.num_simulations} simulations "
                "of the design are missing, by faults of the simulator; they were left "
                "out",
                MissingRowsWarning,
            )
        return design

    def _budget(self, budget: int | None, listed: Tensor | None) -> int:
        """Return the simulations of an action in all.

        Raises:
            ValueError: If the budget is too small.
        """
        if budget is None:
            size = self.search.size(self.actions) if listed is None else len(listed)
            return self.num_samples * size
        least = 0 if listed is None else 8 * len(listed)
        advice = "allow more simulations or fewer candidates"
        require(budget >= least, f"a budget >= {least}, 8 a candidate", budget, advice)
        return budget
