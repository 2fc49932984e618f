"""The leading candidate, its probability, and those still in reach."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_active.seeding import derive_seed

#: Draws behind ``probability_best``; its standard error is at most .016.
DRAWS = 1_000
SURE = 0.95  # probability that the leader is the best, at which to stop
NEGLIGIBLE = 0.05  # expected loss in nats at which to stop
REACH = 3.0  # standard errors within which candidates stay


@dataclass(frozen=True)
class Race:
    r"""The leading candidate and its probability, under the central limit.

    The means of the candidates are jointly Gaussian with the covariance of the paired
    contributions over n. It is applied through the contributions themselves,
    :math:`\sum_i w_i (g_i - \bar g) / n` with standard normal weights, which needs no
    factor of an almost singular matrix and lets candidates differ in n.

    Attributes:
        leader: Index of the largest mean.
        probability_best: Probability of being the best, shape (a,).
        regret: Expected loss by choosing the leader, nats.
        in_reach: Mask of those within some standard errors of the leader, shape (a,),
            bool.
    """

    leader: int
    probability_best: Tensor
    regret: float
    in_reach: Tensor

    @staticmethod
    def run(contributions: list[Tensor], seed: int) -> Race:
        """Compare candidates by contributions (n,) each, NaN where a row is missing.

        Their first rows are common. The seed is that of the draws behind probabilities.
        """
        longest = max(map(len, contributions))
        generator = torch.Generator().manual_seed(derive_seed(seed, "best"))
        weights = torch.randn(longest, DRAWS, generator=generator, dtype=torch.float64)
        mean = torch.stack([row.nanmean() for row in contributions])
        draws = torch.stack(
            [
                m + (row - m).nan_to_num(0.0) @ weights[: len(row)] / _count(row)
                for m, row in zip(mean, contributions, strict=True)
            ]
        )
        best = torch.bincount(draws.argmax(0), minlength=len(contributions))
        leader = int(mean.argmax())
        regret = float((draws.amax(0) - draws[leader]).mean())
        reach = mean + REACH * paired_errors(contributions, leader)
        in_reach = reach >= mean[leader]
        return Race(leader, best.double() / DRAWS, regret, in_reach)

    def reason(self) -> str | None:
        """Why no further simulations are needed; None if they are."""
        if float(self.probability_best[self.leader]) > SURE:
            return "leader separated"
        if self.regret < NEGLIGIBLE:
            return "difference negligible"
        return None


def paired_errors(contributions: list[Tensor], chosen: int) -> Tensor:
    """Standard errors of the differences to one candidate, on what they share."""
    other = contributions[chosen]
    return torch.stack(
        [standard_error(row[: len(other)] - other[: len(row)]) for row in contributions]
    )


def standard_error(contributions: Tensor) -> Tensor:
    """Standard error of the mean of contributions, shape (n,), NaN where missing."""
    known = contributions[contributions.isfinite()]
    return known.std() / len(known) ** 0.5


def _count(contributions: Tensor) -> int:
    return int(contributions.isfinite().sum())
