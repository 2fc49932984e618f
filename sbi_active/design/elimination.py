"""Successive elimination of candidates on common random numbers."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_active.design.eligibility import DesignLimits
from sbi_active.design.evaluator import GainEvaluator
from sbi_active.information_gain import CandidateSimulations
from sbi_active.information_gain.race import Race

MOST = 4  # times num_samples that a candidate may get


@dataclass(frozen=True)
class Estimates:
    """Contributions to the information gain of candidates.

    Attributes:
        action: Candidates, shape (a, action_dim).
        choosing: Contributions of the simulations that chose, one tensor (n,) a
            candidate.
        reporting: Contributions of the simulations that report, one tensor (n,) a
            candidate.
        num_samples: Simulations of each candidate, shape (a,).
        probability_valid: Share of them with a measurement, shape (a,).
        eligible: Mask of those that may be chosen, shape (a,), bool.
        leader: The candidate of the largest utility.
        stopped: Reason why no further simulations were run.
        notes: Notes on the estimates.
    """

    action: Tensor
    choosing: list[Tensor]
    reporting: list[Tensor]
    num_samples: Tensor
    probability_valid: Tensor
    eligible: Tensor
    leader: int
    stopped: str
    notes: tuple[str, ...]


def eliminate(
    evaluator: GainEvaluator,
    action: Tensor,
    *,
    num_samples: int,
    early: bool,
    budget: int,
    limits: DesignLimits,
    seed: int,
) -> Estimates:
    """Simulate candidates until one leads, in ever smaller groups.

    Args:
        evaluator: Evaluator that simulates and estimates.
        action: Candidates, shape (a, action_dim).
        num_samples: Simulations a candidate on average.
        early: Whether to begin with half of them.
        budget: Simulations in all, those of the sampler so far included.
        limits: Limits of the choice.
        seed: Seed of the draws behind probabilities.
    """
    num_actions = len(action)
    sampler = evaluator.sampler
    place = evaluator.add(action)
    size = max(8, num_samples // (2 if early else 1))
    others = evaluator.num_others
    size = min(size, (budget - sampler.num_drawn) // (num_actions + others)) // 4 * 4
    first = evaluator.draw(size, place)
    notes = [*evaluator.notes, *evaluator.estimator.remarks(first)]
    halves = _halves(first)
    num_valid, num_counted = first.num_valid()
    eligible = limits.reached_by(num_valid / num_counted)
    notes += limits.excluded_note(eligible)
    cost = limits.cost(action)
    weight = cost.mean() / cost

    gains = [[torch.empty(0)] * num_actions for _ in range(2)]

    def estimate(index: Tensor, halves: list[CandidateSimulations]) -> None:
        for half, gain in zip(halves, gains, strict=True):
            for a, row in zip(index.tolist(), evaluator(half), strict=True):
                gain[a] = row

    active, excluded = (torch.nonzero(e)[:, 0] for e in (eligible, ~eligible))
    if len(excluded):  # estimated once, never chosen
        estimate(excluded, [half.candidates(excluded) for half in halves])
        halves = [half.candidates(active) for half in halves]
    runs = 2 if evaluator.replicates else 1
    while True:
        estimate(active, halves)
        race = Race.run([weight[a] * gains[0][a] for a in active], seed)
        keep = race.in_reach
        spent = 2 * len(halves[0].theta) * runs
        more = min(
            spent,
            MOST * num_samples - spent,
            (budget - sampler.num_drawn) // (int(keep.sum()) + others) // 4 * 4,
        )
        stopped = race.reason()
        if stopped is None and more < 8:
            stopped = "budget spent"
        if stopped is not None:
            break
        active = active[keep]
        drawn = evaluator.draw(more, place[active])
        for count, new in zip((num_valid, num_counted), drawn.num_valid(), strict=True):
            count[active] += new
        halves = [
            half.candidates(keep).join(new)
            for half, new in zip(halves, _halves(drawn), strict=True)
        ]
    contributions = torch.stack([gains[0][a] for a in active])
    notes += evaluator.disagreements(halves[0], contributions)
    notes += getattr(sampler, "notes", [])
    return Estimates(
        action=action,
        choosing=gains[0],
        reporting=gains[1],
        num_samples=torch.tensor(
            [runs * (len(a) + len(b)) for a, b in zip(*gains, strict=True)]
        ),
        probability_valid=num_valid / num_counted.double(),
        eligible=eligible,
        leader=int(active[race.leader]),
        stopped=stopped,
        notes=tuple(notes),
    )


def _halves(simulations: CandidateSimulations) -> list[CandidateSimulations]:
    half = len(simulations.theta) // 2
    return [
        simulations.samples(slice(half)),
        simulations.samples(slice(half, 2 * half)),
    ]
