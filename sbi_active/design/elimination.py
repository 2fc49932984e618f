"""Successive elimination of candidates, by estimates of what they tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.design.design import Design
from sbi_active.design.estimators.automatic import choose_estimator
from sbi_active.design.estimators.base import (
    CandidateSimulations,
    Sampler,
    standard_error,
)
from sbi_active.design.estimators.entropy import EntropyGain
from sbi_active.design.limits import DesignLimits
from sbi_active.design.outcomes import JointLikelihood, conditional_gain
from sbi_active.design.sampler import CandidateSampler
from sbi_active.design.search import Evaluations, Objective, Search
from sbi_active.seeding import derive_seed
from sbi_active.threads import single_thread


class Race:
    r"""The leading candidate and its probability, under the central limit.

    The means of the candidates are jointly Gaussian with the covariance of the paired
    contributions over n. It is applied through the contributions themselves,
    :math:`\sum_i w_i (g_i - \bar g) / n` with standard normal weights, which needs no
    factor of an almost singular matrix and lets candidates differ in n.

    Args:
        contributions: Contributions of the candidates to their estimates, shape (a, n),
            NaN where a row is missing. Rows are common.
        seed: Seed of the draws behind probabilities.
        num_draws: Number of these draws; with a thousand the standard error of a
            probability is at most .016.
        reach: Standard errors within which a candidate stays; with half as many the
            best of several is dropped now and then.

    Attributes:
        leader: Index of the largest mean.
        probability_best: Probability of being the best, shape (a,).
        regret: Expected loss by choosing the leader, nats.
        in_reach: Mask of those within some standard errors of the leader, shape (a,),
            bool.
    """

    def __init__(
        self,
        contributions: Tensor,
        seed: int,
        *,
        num_draws: int = 1_000,
        reach: float = 3.0,
    ) -> None:
        generator = torch.Generator().manual_seed(derive_seed(seed, "best"))
        size = contributions.shape[1], num_draws
        weights = torch.randn(size, generator=generator, dtype=torch.float64)
        mean, num = contributions.nanmean(1), contributions.isfinite().sum(1)
        off = (contributions - mean[:, None]).nan_to_num(0.0)
        draws = mean[:, None] + off @ weights / num[:, None]
        best = torch.bincount(draws.argmax(0), minlength=len(mean))
        self.probability_best = best.double() / num_draws
        self.leader = int(mean.argmax())
        self.regret = float((draws.amax(0) - draws[self.leader]).mean())
        error = standard_error(contributions - contributions[self.leader])
        self.in_reach = mean + reach * error >= mean[self.leader]

    def reason(self, negligible: float, *, sure: float = 0.95) -> str | None:
        """Return why no further simulations are needed; None if they are.

        Args:
            negligible: Expected loss at which to stop, nats.
            sure: Probability that the leader is the best, at which to stop.
        """
        if float(self.probability_best[self.leader]) > sure:
            return "leader separated"
        return "difference negligible" if self.regret < negligible else None


@dataclass
class GainEvaluator:
    """Draws outcomes of candidates, estimates what these tell, and chooses one.

    Attributes:
        sampler: Sampler of the outcomes.
        estimator: Estimator of the information; None is chosen by the first draw.
        model: Model that the estimator needs.
        belief: Distribution of the parameters; None for rivals.
        limits: Limits and costs of the actions.
        seed: Seed of the search, and of the draws behind probabilities.
        notes: Notes on failed checks of the estimator, or why others were not taken;
            None before the first simulations.
    """

    sampler: Sampler
    estimator: Any
    model: Any
    belief: Distribution | None
    limits: DesignLimits
    seed: int
    notes: list[str] | None = None

    def __post_init__(self) -> None:
        self.num_others = len(self.sampler.others)
        if self.num_others:  # of joint outcomes nothing else says anything
            joint = JointLikelihood(self.model, self.sampler.others.shape[1])
            self.model = joint if hasattr(self.model, "log_likelihood") else None

    def draw(
        self, num_samples: int, action: Tensor, *, halves: bool = False
    ) -> CandidateSimulations:
        """Simulate candidates (a, action_dim); the first call settles the estimator.

        Args:
            num_samples: Simulations of a candidate.
            action: Candidates.
            halves: Whether an estimate will rest on half of them.
        """
        sampler = self.sampler
        drawn = sampler.draw(num_samples, action)
        if self.notes is not None:
            return drawn
        if self.estimator is None:
            num_rows = num_samples // 2 if halves else num_samples
            given = self.model, drawn, self.belief, num_rows
            self.estimator, self.notes = choose_estimator(*given)
            # A model was learned from whole outcomes.
            if sampler.summaries is not None and self.estimator.needs_model:
                sampler.summaries = None
                sampler.rewind()
                return sampler.draw(num_samples, action)
        else:
            self.notes = self.estimator.problems(drawn)
        if not self.estimator.needs_slopes(drawn):
            return drawn
        assert isinstance(sampler, CandidateSampler)
        sampler.has_slopes = True
        return sampler.add_slopes(drawn)

    def __call__(self, simulations: CandidateSimulations) -> Tensor:
        """Return contributions, shape (a, n), nats."""
        given = self.model, simulations, self.belief
        with single_thread():
            if self.num_others:
                return conditional_gain(self.estimator, *given, self.num_others)
            return self.estimator(*given)

    def objective(
        self, search: Search, budget: int, num_samples: int, *, share: int = 12
    ) -> Objective:
        """Return what a search maximizes, estimated at the same parameters.

        Args:
            search: Search that maximizes it.
            budget: Simulations of the design.
            num_samples: Simulations a candidate on average.
            share: An evaluation has one of so many shares of these, but as many as the
                estimator needs; of a fourth as many its errors are twice as large.
        """
        num = max(self._least(num_samples // 2), num_samples // share // 4 * 4)

        def evaluate(action: Tensor) -> Evaluations:
            self.sampler.rewind()
            drawn = self.draw(num, action)
            gain, cost = self(drawn), self.limits.cost(action)
            valid, counted = drawn.num_valid()
            error, valid = standard_error(gain) / cost, valid / counted.double()
            return Evaluations(action, gain.nanmean(1) / cost, error, valid)

        return Objective(
            actions=self.limits.actions,
            permitted=self.limits,
            evaluate=evaluate,
            num_evaluations=search.num_evaluations(budget, num),
            seed=derive_seed(self.seed, "search"),
            min_probability_valid=self.limits.least,
        )

    def _least(self, most: int) -> int:
        """Return the simulations that an estimate needs, at most so many."""
        needed = (self.estimator or EntropyGain).fewest  # by which one is chosen
        return max(8, min(needed, most // 4 * 4))

    def eliminate(
        self,
        action: Tensor,
        budget: int,
        *,
        num_samples: int,
        share: float,
        negligible: float,
        notes: Sequence[str] = (),
        most: int = 4,
    ) -> Design:
        """Simulate candidates until one leads, in ever smaller groups; return it.

        Args:
            action: Candidates, shape (a, action_dim).
            budget: Simulations in all, those so far included.
            num_samples: Simulations a candidate on average.
            share: Share of these that every candidate gets at first.
            negligible: Expected loss at which to stop, nats.
            notes: Notes on the candidates, the last of the design's.
            most: Times ``num_samples`` that a candidate may get at most.
        """
        sampler, limits, num_actions = self.sampler, self.limits, len(action)

        def affordable(num: int, num_candidates: int) -> int:
            each = (budget - sampler.num_drawn) // (num_candidates + self.num_others)
            return min(num, each // 4 * 4)

        # Slopes that a search had may have spent what was the finalists'.
        size = max(int(share * num_samples), 2 * self._least(num_samples // 2))
        size = max(8, affordable(size // 4 * 4, num_actions))
        first = self.draw(size, action, halves=True)
        said = [*(self.notes or ()), *self.estimator.remarks(first)]
        halves = _halves(first)
        num = first.num_valid()
        eligible = limits.reached_by(num[0] / num[1])
        said += limits.excluded_note(eligible)
        cost = limits.cost(action)
        weight = (cost.mean() / cost)[:, None]
        runs, spent = len(first.outcomes()), torch.zeros(num_actions).long()
        gains = torch.empty(2, num_actions, 0).double()

        def estimate(index: Tensor, halves: list[CandidateSimulations]) -> Tensor:
            """Return all gains with those of some candidates, NaN where none is."""
            found = torch.stack([self(half) for half in halves])
            spent[index] = 2 * found.shape[2] * runs
            padding = 0, found.shape[2] - gains.shape[2]
            every = torch.nn.functional.pad(gains, padding, value=torch.nan)
            every[:, index] = found
            return every

        active, excluded = (torch.nonzero(e)[:, 0] for e in (eligible, ~eligible))
        if len(excluded):  # estimated once, never chosen
            gains = estimate(excluded, [half.candidates(excluded) for half in halves])
            halves = [half.candidates(active) for half in halves]
        while True:
            gains = estimate(active, halves)
            race = Race(weight[active] * gains[0, active], self.seed)
            keep = race.in_reach
            own = int(spent[active[0]])
            more = affordable(min(own, most * num_samples - own), int(keep.sum()))
            stopped = race.reason(negligible) or ("budget spent" if more < 8 else None)
            if stopped is not None:
                break
            active = active[keep]
            drawn = self.draw(more, action[active])
            num[:, active] += drawn.num_valid()
            halves = [
                half.candidates(keep).join(new)
                for half, new in zip(halves, _halves(drawn), strict=True)
            ]
        with single_thread():
            known = self.model, halves[0], self.belief, gains[0, active]
            said += self.estimator.compared(*known)
        # A difference of two bounds is none.
        bound = "none" if self.num_others else self.estimator.bound_on(self.model)
        if bound == "lower" and bool((gains[:, active].nanmean((0, 2)) < 0).all()):
            said.append(
                "no lower bound is above 0 nats, so that candidates are not ranked; "
                "declare the noise, SimulatorModel(fn, noise=...), or train on more"
            )
        return choose(
            *(limits, action, gains, eligible, int(active[race.leader]), self.seed),
            probability_valid=num[0] / num[1].double(),
            bound=bound,
            num_simulations=sampler.num_drawn,
            num_missing=sampler.num_missing,
            num_samples=spent,
            estimator=type(self.estimator).__name__,
            stopped=stopped,
            notes=(*said, *sampler.notes, *notes),
        )


def choose(
    limits: DesignLimits,
    action: Tensor,
    halves: Tensor,
    eligible: Tensor,
    leader: int,
    seed: int,
    **known: Any,
) -> Design:
    """Return the design of the leading candidate.

    Args:
        limits: Limits and costs of the actions.
        action: Candidates, shape (a, action_dim).
        halves: Contributions of the simulations that chose, and of those that report,
            shape (2, a, n), NaN where there are none.
        eligible: Mask of the candidates that may be chosen, shape (a,), bool.
        leader: The candidate of the largest utility.
        seed: Seed of the draws behind probabilities.
        **known: Fields of the :class:`.Design` that are known already.
    """
    price, report = limits.cost(action), halves[1]
    probability_best = torch.zeros(len(price)).double()
    utility = torch.cat([*halves], 1)[eligible] / price[eligible, None]
    probability_best[eligible] = Race(utility, seed).probability_best
    return Design(
        action=action[leader],
        candidates=action,
        expected_information_gain=report.nanmean(1),
        standard_error=standard_error(report),
        difference_standard_error=standard_error(report - report[leader]),
        probability_best=probability_best,
        index=leader,
        cost=None if limits.price is None else price,
        labels=limits.actions.entry_labels,
        **known,
    )


def _halves(simulations: CandidateSimulations) -> list[CandidateSimulations]:
    half = len(simulations.theta) // 2
    return [simulations.samples(slice(k * half, (k + 1) * half)) for k in range(2)]


def as_batch(steps: list[Design]) -> Design:
    """Return the design of several actions, or the only step itself."""
    if len(steps) == 1:
        return steps[0]
    return replace(
        steps[-1],
        action=torch.stack([step.action for step in steps]),
        num_simulations=sum(step.num_simulations for step in steps),
        num_missing=sum(step.num_missing for step in steps),
        notes=tuple(dict.fromkeys(note for step in steps for note in step.notes)),
        steps=tuple(steps),
    )
