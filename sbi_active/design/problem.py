"""What a design is about, and the estimates of what its candidates tell."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.design.estimators.automatic import (
    choose_estimator,
    disagreements,
    find_estimator,
)
from sbi_active.design.estimators.base import (
    Bound,
    CandidateSimulations,
    InformationGainEstimator,
)
from sbi_active.design.estimators.linear import LinearGain
from sbi_active.design.estimators.model_index import ModelIndexGain, RivalSampler
from sbi_active.design.estimators.posterior import ParameterGain
from sbi_active.design.limits import DesignLimits
from sbi_active.design.outcomes import JointLikelihood, conditional_gain
from sbi_active.design.sampler import CandidateSampler
from sbi_active.design.search import Search
from sbi_active.design.target import Quantity, Target, name_of, places
from sbi_active.simulation import Simulations
from sbi_active.simulation.workers.settings import Workers
from sbi_active.threads import single_thread


@dataclass(frozen=True, kw_only=True)
class DesignProblem:
    """The choice of one action; see :class:`.InformationGainDesigner`.

    Attributes:
        target: "theta", names of parameters, a function of these, or "model".
        given_estimator: Estimator of the information, as the designer was given it.
        model: Model that the estimator needs.
        simulator: ``simulator(theta, action)``.
        belief: Distribution of the parameters; not used for the target "model".
        limits: Limits of the actions.
        search: Search for the candidates.
        num_samples: Simulations a candidate on average.
        eliminate: Whether candidates begin with half of them.
        workers: Workers that run the simulations.
        most_numbers: Number of an outcome's numbers beyond which summaries stand for
            them.
        others: Actions whose outcomes will be known as well, shape (p, action_dim).
        simulations: Rows at hand; None simulates.
        budget: Simulations in all; None is ``num_samples`` a candidate.
        seed: Seed of all draws.

    Raises:
        ValueError: If what the target needs is lacking.
    """

    target: Target
    given_estimator: str | InformationGainEstimator
    model: Any
    simulator: Callable[..., Any] | None
    belief: Distribution | None
    limits: DesignLimits
    search: Search
    num_samples: int
    eliminate: bool
    workers: Workers
    most_numbers: float
    others: Tensor
    simulations: Simulations | None
    budget: int | None
    seed: int

    def __post_init__(self) -> None:
        simulates = self.simulations is None
        own = ("auto",) if self.target == "model" else ("auto", "linear")
        if self.target != "theta" and self.given_estimator not in own:
            raise ValueError(
                f"expected estimator={' or '.join(map(repr, own))} for "
                f"target={name_of(self.target)!r}; got {self.given_estimator!r}; "
                "leave out estimator="
            )
        if self.target == "model":
            if not isinstance(self.model, Sequence) or not simulates:
                got = type(self.model).__name__ if simulates else "given simulations"
                raise ValueError(
                    "expected a sequence of rivals for target='model'; got "
                    f"{got}; pass objects with probability and "
                    "predict(action, num_samples, seed)"
                )
        elif self.simulator is None and simulates:
            raise ValueError(
                "expected a simulator; got None; pass the one that the belief's "
                "parameters belong to"
            )
        elif self.belief is None:
            raise ValueError(
                "expected belief=, the distribution of the parameters; got none, and "
                "the model has none; pass the belief of this round"
            )

    def _numbers(self) -> list[int] | Quantity:
        """Return the places of the parameters that it is about, or their function."""
        if callable(self.target):
            assert self.belief is not None
            return Quantity(self.target, self.simulator, self.belief)
        return places(self.target, self.simulator)

    def estimator(self) -> InformationGainEstimator | None:
        """Return the estimator; None if the simulations are to decide.

        Raises:
            ValueError: If it needs a model and there is none, or a name is unknown.
        """
        if self.target == "model":
            return None
        if self.target != "theta":
            target, options = self._numbers(), {}
            if isinstance(target, Quantity):
                options["num_marginal"] = target.num_draws
            is_linear = self.given_estimator == "linear"
            return LinearGain(target) if is_linear else ParameterGain(target, **options)
        estimator = find_estimator(self.given_estimator)
        if estimator is not None and estimator.needs_model and self.model is None:
            raise ValueError(
                f"expected a model for {type(estimator).__name__}; got None; pass "
                "the trained posterior, or estimator='auto'"
            )
        return estimator


class GainEvaluator:
    """Estimates of the information gain of candidates, by simulation.

    Args:
        problem: Problem of the design.
        action: Candidates to look at the simulator with, shape (a, action_dim).

    Attributes:
        sampler: Sampler of the outcomes.
        notes: Notes on failed checks of the estimator, or why others were not taken.
        replicates: Whether every row is simulated twice; None before the first.

    Raises:
        ValueError: If other outcomes have no place in the target or the estimator.
    """

    def __init__(self, problem: DesignProblem, action: Tensor) -> None:
        self.problem = problem
        self.sampler, self._chosen = _sampler(problem, action)
        self.notes: list[str] = []
        self.replicates: bool | None = None

    @property
    def num_others(self) -> int:
        """Number of actions whose outcomes will be known as well."""
        return len(self.problem.others)

    @property
    def estimator(self) -> InformationGainEstimator:
        """The estimator given, or the one chosen by the first simulations."""
        assert self._chosen is not None
        return self._chosen

    @property
    def bound(self) -> Bound:
        """Side of the information that the estimates lie on.

        A difference of two bounds is none.
        """
        if self.num_others:
            return "none"
        return self.estimator.bound_on(self.problem.model)

    def add(self, action: Tensor) -> Tensor:
        """Add candidates (k, action_dim); return their indices, shape (k,)."""
        num = len(self.sampler.action)
        self.sampler.action = torch.cat([self.sampler.action, action])
        return num + torch.arange(len(action))

    def draw(self, num_samples: int, index: Tensor) -> CandidateSimulations:
        """Simulate candidates (k,); the first call settles the estimator."""
        sampler = self.sampler
        if self.replicates is not None:
            return sampler.draw(num_samples, index, replicates=self.replicates)
        replicates = self._chosen is None or self._chosen.needs_noise
        first = sampler.draw(num_samples, index, replicates=replicates)
        if self._chosen is not None:
            self.notes = self._chosen.problems(first)
        else:
            model: Any = self.problem.model
            if self.num_others and model is not None:
                model = JointLikelihood(model, sampler.action.shape[1])
            listed = self.problem.limits.actions.listed() is not None
            # Of a list the first simulations are compared, half of them at a time.
            num_rows = num_samples // 2 if listed else num_samples
            self._chosen, self.notes = choose_estimator(model, first, num_rows=num_rows)
            # A model was learned from whole outcomes.
            if sampler.summaries is not None and self._chosen.needs_model:
                sampler.summaries = None
                sampler.rewind()
                first = sampler.draw(num_samples, index, replicates=replicates)
        self.replicates = first.replicate is not None
        return first

    def __call__(self, simulations: CandidateSimulations) -> Tensor:
        """Return contributions, shape (a, n), nats."""
        model, belief = self.problem.model, self.problem.belief
        with single_thread():
            if not self.num_others:
                return self.estimator(model, simulations, belief)
            action_dim = self.sampler.action.shape[1]
            return conditional_gain(
                self.estimator, model, simulations, belief, action_dim=action_dim
            )

    def disagreements(
        self, simulations: CandidateSimulations, gain: Tensor
    ) -> list[str]:
        """Return the disagreements of other estimators, see :func:`.disagreements`."""
        if self.num_others:
            return self.estimator.cautions(gain)
        model = self.problem.model if self.sampler.summaries is None else None
        with single_thread():
            return disagreements(
                self.estimator, model, simulations, self.problem.belief, gain
            )


def _sampler(
    problem: DesignProblem, action: Tensor
) -> tuple[CandidateSampler | RivalSampler, InformationGainEstimator | None]:
    """Return the sampler of outcomes of candidates, and the estimator if settled."""
    others, model = problem.others, problem.model
    if problem.target == "model":
        if len(others):
            raise ValueError(
                "expected one action at a time and none pending for "
                f"target='model'; got {len(others)} others; ask for them in turn"
            )
        rivals = RivalSampler(model, action, problem.seed)
        return rivals, ModelIndexGain(rivals.probability)
    assert problem.belief is not None
    assert problem.simulator is not None
    estimator = problem.estimator()
    learns = estimator is not None and estimator.needs_model
    if len(others) and learns and not hasattr(model, "log_likelihood"):
        raise ValueError(
            "expected an estimator of the joint information of several actions, "
            "by the noise or by a model with log_likelihood; got "
            f"{type(estimator).__name__} on {type(model).__name__}, which "
            "knows single outcomes; use estimator='auto', or one action at a "
            "time without pending ones"
        )
    sampler = CandidateSampler(
        problem.simulator,
        problem.belief,
        action,
        problem.seed,
        problem.workers,
        others,
        # A model was learned from whole outcomes.
        most_numbers=float("inf") if learns else problem.most_numbers,
    )
    return sampler, estimator
