"""The choice of one action, by simulation or by simulations at hand."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from sbi_active.design.choice import choose
from sbi_active.design.design import Design
from sbi_active.design.eligibility import DesignLimits
from sbi_active.design.elimination import eliminate
from sbi_active.design.evaluator import GainEvaluator
from sbi_active.design.given import GivenGains
from sbi_active.design.target import Target
from sbi_active.information_gain import CandidateSimulations, InformationGainEstimator
from sbi_active.information_gain.estimators.automatic import choose_estimator
from sbi_active.information_gain.race import standard_error
from sbi_active.search import Evaluations, Objective, Search
from sbi_active.seeding import derive_seed
from sbi_active.simulation import Simulations
from sbi_active.simulation.workers.settings import Workers

SHARE = 12  # of num_samples, that an action evaluated by a search gets one of
FEW = 256  # given rows by which to choose the estimator


@dataclass(frozen=True)
class Selection:
    """The choice of one action; see :class:`.InformationGainDesigner`.

    Attributes:
        target: Target that is learned about.
        limits: Limits of the actions.
        search: Search for the candidates.
        num_samples: Simulations a candidate on average.
        early: Whether candidates begin with half of them.
        workers: Workers that run the simulations.
        seed: Seed of all draws.
        most_numbers: Number of an outcome's numbers beyond which summaries stand for
            them.
    """

    target: Target
    limits: DesignLimits
    search: Search
    num_samples: int
    early: bool
    workers: Workers
    seed: int
    most_numbers: float

    def by_simulation(self, others: Tensor, budget: int | None) -> Design:
        """Return the design of one action, given others (p, action_dim) under way.

        Raises:
            ValueError: If the budget is too small.
        """
        actions, target = self.limits.actions, self.target
        listed, notes = self.limits.listed()
        if budget is None:
            size = self.search.size(actions) if listed is None else len(listed)
            budget = self.num_samples * size
        if listed is not None and budget < 8 * len(listed):
            raise ValueError(
                f"expected a budget >= {8 * len(listed)}, 8 a candidate; got {budget}; "
                "allow more simulations or fewer candidates"
            )
        probed = listed
        if probed is None:
            probed = actions.sample((16,), seed=derive_seed(self.seed, "probed"))
        sampler, estimator = target.sampler(
            probed, others, self.seed, self.workers, most_numbers=self.most_numbers
        )
        evaluator = GainEvaluator(sampler, estimator, target.model, target.belief)
        num_samples = max(8, self.num_samples // SHARE // 4 * 4)
        action = self.search.finalists(
            Objective(
                actions=actions,
                permitted=self.limits,
                evaluate=lambda rows: self._evaluate(evaluator, rows, num_samples),
                num_evaluations=self.search.num_evaluations(budget, num_samples),
                seed=derive_seed(self.seed, "search"),
                min_probability_valid=self.limits.least,
            )
        )
        estimates = eliminate(
            evaluator,
            action,
            num_samples=self.num_samples,
            early=self.early,
            budget=budget,
            limits=self.limits,
            seed=self.seed,
        )
        return choose(
            replace(estimates, notes=(*estimates.notes, *notes)),
            self.limits,
            estimator=type(evaluator.estimator).__name__,
            bound=evaluator.bound,
            num_simulations=sampler.num_drawn,
            num_missing=sampler.num_missing,
            seed=self.seed,
        )

    def by_given(self, simulations: Simulations) -> Design:
        """Return the design by rows at hand; nothing is simulated.

        Raises:
            TypeError: If they are no simulations.
            ValueError: If they are of other actions, or the estimator cannot be made
                from single rows.
        """
        target, actions = self.target, self.limits.actions
        if not isinstance(simulations, Simulations):
            raise TypeError(
                "expected Simulations(theta, action, x) for simulations=; got "
                f"{type(simulations).__name__}; wrap the rows in it"
            )
        if simulations.action.shape[1] != actions.action_dim:
            raise ValueError(
                f"expected simulations of actions (n, {actions.action_dim}); got "
                f"{tuple(simulations.action.shape)}; pass those of this space"
            )
        listed, notes = self.limits.listed()
        estimator = target.gain() or _by_model(target.model, simulations)
        assert target.belief is not None
        given = GivenGains(
            simulations, estimator, target.model, target.belief, self.limits, self.seed
        )
        estimates = (
            given.of_space(self.search) if listed is None else given.of_list(listed)
        )
        return choose(
            replace(estimates, notes=(*estimates.notes, *notes)),
            self.limits,
            estimator=type(estimator).__name__,
            bound="none",  # the model may have seen the rows
            num_simulations=0,
            num_missing=0,
            seed=self.seed,
        )

    def _evaluate(
        self, evaluator: GainEvaluator, action: Tensor, num_samples: int
    ) -> Evaluations:
        """Estimate the utility at parameters that are the same from call to call."""
        evaluator.sampler.rewind()
        drawn = evaluator.draw(num_samples, evaluator.add(action))
        gain, cost = evaluator(drawn), self.limits.cost(action)
        valid, counted = drawn.num_valid()
        error = torch.stack([standard_error(row) for row in gain])
        return Evaluations(
            action, gain.nanmean(1) / cost, error / cost, valid / counted.double()
        )


def _by_model(model: Any, simulations: Simulations) -> InformationGainEstimator:
    """Return the estimator by what the model can say."""
    if model is None:
        raise ValueError(
            "expected a model with simulations=; got None; pass the trained model, "
            "or leave out simulations="
        )
    some = CandidateSimulations(
        simulations.theta[:FEW], simulations.action[:1], simulations.x[None, :FEW]
    )
    return choose_estimator(model, some)[0]
