"""Choose the next action by expected information gain."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace
from sbi_active.actions.discrete import Actions, action_space
from sbi_active.design.choice import as_batch, pricing
from sbi_active.design.design import Design
from sbi_active.design.eligibility import DesignLimits, rows_of, warn_missing
from sbi_active.design.selection import Selection
from sbi_active.design.target import Target
from sbi_active.information_gain import InformationGainEstimator
from sbi_active.information_gain.estimators.automatic import find_estimator
from sbi_active.search import (
    BayesianOptimization,
    ExhaustiveSearch,
    GradientSearch,
    Search,
)
from sbi_active.seeding import derive_seed
from sbi_active.simulation import Simulations
from sbi_active.simulation.workers.settings import IN_PROCESS, Workers

#: Name of a search: its class.
SEARCHES: dict[str, type[Search]] = {
    "exhaustive": ExhaustiveSearch,
    "gradient": GradientSearch,
    "bayesopt": BayesianOptimization,
}


class InformationGainDesigner:
    r"""Choose :math:`\xi^* = \arg\max_\xi I(\theta; x | \xi) / c(\xi)`.

    A search finds the candidates: all actions of a list; in a continuous or mixed space
    those at which a regression of the gain is largest. They are then simulated at the
    same parameters, so that estimates are compared on common random numbers. Half of
    these simulations choose; the others report, since the largest of many noisy
    estimates is too large. Every candidate first gets half of ``num_samples``. Those
    within some standard errors of the leader then get twice as many again and again,
    until the leader is the best with a probability of .95, or is expected to lose less
    than .05 nat, or the budget is spent (successive elimination). The report has no
    part in this.

    Args:
        actions: The action space, or a list of actions.
        num_samples: Simulations a candidate on average; an action that stays among the
            leading ones gets at most four times as many. A search of a box spends as
            many as for four candidates, four more each entry, and four more each
            category after the first; half of them on comparing its finalists.
        estimator: Estimator of the information gain; the name of one (see
            :mod:`sbi_active.information_gain`); or "auto". That takes declared noise
            first (entropies by nearest neighbors where x is one number, nested Monte
            Carlo where it is more), then the same with noise from replicates that pass
            a test of normality, else what the model can say.
        search: A search; "exhaustive", "gradient" or "bayesopt" (see
            :mod:`sbi_active.search`); or "auto", exhaustive for lists, else gradient.
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
        TypeError: If the search does not apply to the action space.

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
        if num_samples < 8:
            raise ValueError(
                f"expected num_samples >= 8, half to choose and half to report; got "
                f"{num_samples}; use about 1000"
            )
        self.actions = actions = action_space(actions)
        self.num_samples = num_samples
        self.estimator, self.eliminate = estimator, eliminate
        self.search = _find_search(search, actions)
        self.search.size(actions)  # a search that does not apply is an error here
        self.workers, self.most_numbers = workers, most_numbers
        find_estimator(estimator)  # an unknown name is an error here

    def select(
        self,
        model: Any,
        simulator: Callable[..., Any] | None = None,
        *,
        belief: Distribution | None = None,
        target: str | Sequence[str] = "theta",
        simulations: Simulations | None = None,
        cost: Callable[[Tensor], Tensor] | Tensor | None = None,
        constraint: Callable[[Tensor], Tensor] | None = None,
        exclude: Tensor | None = None,
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
                :class:`.LinearGain` where the estimator is "linear"); or "model", the
                index of the rivals (:class:`.ModelIndexGain`). The estimates of
                ParameterGain and of the latter are lower bounds.
            simulations: Rows under the belief, such as those that the model was trained
                on; then nothing is simulated. Half of them choose and half report, but
                where the model has seen them, both are too high.
            cost: Cost of actions (n, action_dim), shape (n,), positive; or one number
                an action of a list, shape (a,). The utility is information by cost.
            constraint: Function of actions (n, action_dim) that says which are
                permitted, shape (n,), bool.
            exclude: Actions not to repeat, shape (t, action_dim); in a box nor others
                within a hundredth of its width.
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
        if num_actions < 1:
            raise ValueError(
                f"expected num_actions >= 1; got {num_actions}; ask for one or more"
            )
        others = rows_of(self.actions, pending, "pending")
        limits = DesignLimits(
            self.actions,
            constraint,
            rows_of(self.actions, exclude, "exclude"),
            pricing(cost, self.actions),
            min_probability_valid,
        )
        seed = int(torch.randint(2**62, ())) if seed is None else seed
        about = Target.of(
            target,
            self.estimator,
            model,
            simulator,
            belief,
            simulates=simulations is None,
        )
        selection = Selection(
            target=about,
            limits=limits,
            search=self.search,
            num_samples=self.num_samples,
            early=self.eliminate,
            workers=self.workers,
            seed=seed,
            most_numbers=self.most_numbers,
        )
        if simulations is not None:
            if num_actions > 1 or len(others):
                raise ValueError(
                    "expected one action and none pending with simulations=, rows of "
                    f"single outcomes; got {num_actions} and {len(others)} pending; "
                    "leave out simulations="
                )
            return selection.by_given(simulations)
        steps: list[Design] = []
        for k in range(num_actions):
            if k:
                selection = replace(selection, seed=derive_seed(seed, "action", k))
            steps.append(selection.by_simulation(others, budget))
            others = torch.cat([others, steps[-1].action[None]])
        design = as_batch(steps)
        warn_missing(design.num_missing, design.num_simulations)
        return design


def _find_search(search: str | Search, actions: ActionSpace) -> Search:
    if isinstance(search, Search):
        return search
    if search == "auto":
        return GradientSearch() if actions.listed() is None else ExhaustiveSearch()
    if search not in SEARCHES:
        raise ValueError(
            f"expected search among 'auto', {', '.join(map(repr, SEARCHES))}; got "
            f"{search!r}; choose one of these or pass a search"
        )
    return SEARCHES[search]()
