"""Estimates from simulations at hand, such as those that the model was trained on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.design.cells import cells
from sbi_active.design.eligibility import DesignLimits
from sbi_active.design.elimination import Estimates
from sbi_active.inference.regression.process import GaussianProcess
from sbi_active.information_gain import (
    CandidateSimulations,
    InformationGainEstimator,
)
from sbi_active.information_gain.race import Race
from sbi_active.search.base import Evaluations, Objective, Search
from sbi_active.search.cube import Coordinates
from sbi_active.search.gradient import regression
from sbi_active.seeding import derive_seed
from sbi_active.simulation import Outcome, Simulations
from sbi_active.threads import single_thread

FEWEST = 16  # rows of a candidate
IN_SAMPLE = (
    "estimated on the given simulations: too high where the model was trained on them, "
    "and more so for actions that it overfits"
)
NUM_CELLS = 128  # into which the rows of a continuous space are averaged


@dataclass(frozen=True)
class GivenGains:
    """Estimates without further simulations: half of the rows choose, half report.

    Actions of a list are estimated on their own rows. In a continuous space no two rows
    share an action: contributions of single rows are averaged over cells and a
    regression of the averages gives the estimates, which takes an estimator that scores
    rows one by one.

    Attributes:
        simulations: The rows.
        estimator: Estimator of the information.
        model: Model that the estimator needs.
        belief: Belief over the parameters in the rows.
        limits: Limits of the choice.
        seed: Seed of the split.
    """

    simulations: Simulations
    estimator: InformationGainEstimator
    model: Any
    belief: Distribution
    limits: DesignLimits
    seed: int

    def of_list(self, action: Tensor) -> Estimates:
        """Return estimates of candidates on their own rows.

        Raises:
            ValueError: If no candidate has rows enough.
        """
        halves: list[list[Tensor]] = [[], []]
        share = torch.full((len(action),), torch.nan, dtype=torch.float64)
        for a, own in enumerate(action):
            near = torch.isclose(self.simulations.action, own, rtol=1e-5, atol=1e-7)
            rows = torch.nonzero(near.all(1))[:, 0]
            enough = len(rows) >= FEWEST
            if enough:
                status = self.simulations.status[rows]
                known = (status != Outcome.MISSING).sum()
                share[a] = (status == Outcome.OK).sum() / known
            for gains, half in zip(halves, self._split(rows), strict=True):
                gains.append(
                    self._gain(own, half) if enough else torch.full((2,), torch.nan)
                )
        if bool(share.isnan().all()):
            raise ValueError(
                f"expected simulations with at least {FEWEST} rows of a candidate; got "
                "fewer of every one; pass rows at the actions of the list"
            )
        return self._estimates(action, halves, share)

    def of_space(self, search: Search) -> Estimates:
        """Search a continuous space; return the estimates of the finalists.

        Raises:
            ValueError: If the estimator does not score rows one by one.
        """
        if not self.estimator.rowwise:
            raise ValueError(
                "expected an estimator that scores rows one by one with simulations= "
                f"and continuous actions; got {type(self.estimator).__name__}; use "
                "estimator='posterior', or leave out simulations="
            )
        coordinates = Coordinates(self.limits.actions)
        everything = torch.arange(len(self.simulations))
        averages = [
            self._averages(coordinates, half) for half in self._split(everything)
        ]
        first = averages[0]
        price = self.limits.cost(first.action)
        known = Evaluations(
            first.action,
            first.gain / price,
            first.error / price,
            first.probability_valid,
        )
        action = search.finalists(
            Objective(
                actions=self.limits.actions,
                permitted=self.limits,
                evaluate=_nothing,
                num_evaluations=0,
                seed=derive_seed(self.seed, "search"),
                min_probability_valid=self.limits.least,
                known=known,
            )
        )
        point = coordinates.points(action)
        halves, shares = [], []
        for part in averages:
            knots = coordinates.points(part.action)
            c = coordinates.num_continuous
            gain = regression(knots, part.gain, part.error, num_continuous=c)
            halves.append([*_as_contributions(gain, point)])
            valid = part.probability_valid
            if bool((valid < 1).any()):
                error = (valid * (1 - valid) / part.num + 1e-4).sqrt()
                share = regression(knots, valid, error, num_continuous=c)
                shares.append(share(point)[0][:, 0].clamp(0, 1))
            else:
                shares.append(torch.ones(len(point)).double())
        return self._estimates(action, halves, torch.stack(shares).mean(0))

    def _split(self, rows: Tensor) -> list[Tensor]:
        generator = torch.Generator().manual_seed(derive_seed(self.seed, "split"))
        shuffled = rows[torch.randperm(len(rows), generator=generator)]
        return [*shuffled.tensor_split(2)]

    def _gain(self, action: Tensor, rows: Tensor) -> Tensor:
        """Contributions of rows of one action, shape (n,)."""
        given = self.simulations
        lost = given.status[rows] == Outcome.MISSING
        with single_thread():
            return self.estimator(
                self.model,
                CandidateSimulations(
                    given.theta[rows],
                    action[None],
                    given.x[rows][None],
                    missing=lost[None],
                ),
                self.belief,
            )[0]

    def _averages(self, coordinates: Coordinates, rows: Tensor) -> _Averages:
        given = self.simulations
        status = given.status[rows]
        rows = rows[status != Outcome.MISSING]
        with single_thread():
            gain = self.estimator(
                self.model,
                RowSimulations(
                    given.theta[rows],
                    given.action[rows][:1],
                    given.x[rows][None],
                    each=given.action[rows],
                ),
                self.belief,
            )[0]
        valid = (given.status[rows] == Outcome.OK).double()
        point = coordinates.points(given.action[rows])
        groups = cells(point, NUM_CELLS, num_continuous=coordinates.num_continuous)
        return _Averages(
            coordinates.actions(torch.stack([point[g].mean(0) for g in groups])),
            torch.stack([gain[g].mean() for g in groups]),
            torch.stack([gain[g].std() / len(g) ** 0.5 for g in groups]),
            torch.stack([valid[g].mean() for g in groups]),
            torch.tensor([len(g) for g in groups]),
        )

    def _estimates(
        self,
        action: Tensor,
        halves: list[list[Tensor]],
        share: Tensor,
    ) -> Estimates:
        known = torch.tensor([bool(g.isfinite().any()) for g in halves[0]])
        eligible, cost = known & self.limits.reached_by(share), self.limits.cost(action)
        index = torch.nonzero(eligible)[:, 0]
        race = Race.run([halves[0][a] / cost[a] for a in index], self.seed)
        few = int((~known).sum())
        notes = [IN_SAMPLE, *self.limits.excluded_note(eligible | ~known)]
        if few:
            notes.append(f"{few} candidates with fewer than {FEWEST} rows excluded")
        return Estimates(
            action=action,
            choosing=halves[0],
            reporting=halves[1],
            num_samples=torch.tensor(
                [len(a) + len(b) for a, b in zip(*halves, strict=True)]
            ),
            probability_valid=share,
            eligible=eligible,
            leader=int(index[race.leader]),
            stopped="simulations given",
            notes=tuple(notes),
        )


@dataclass(frozen=True)
class RowSimulations(CandidateSimulations):
    """Rows of which each has an action of its own, for estimators that score rows.

    x has shape (1, n, *x_shape), ``each`` (n, action_dim), and ``action`` is of no
    meaning.
    """

    each: Tensor = field(default_factory=lambda: torch.empty(0))

    def rows(self) -> tuple[Tensor, Tensor]:
        """Return the parameters, and what was drawn at each."""
        return self.theta, self.each


@dataclass(frozen=True)
class _Averages:
    """Of cells: mean action, contributions, their standard error, share of valid."""

    action: Tensor
    gain: Tensor
    error: Tensor
    probability_valid: Tensor
    num: Tensor


def _as_contributions(process: GaussianProcess, point: Tensor) -> Tensor:
    r"""Return numbers whose mean is the regression's, shape (m, cells).

    Their standard error is the root of the sum of squares of what the residual of each
    cell does to the regression (Huber-White), paired between points; or the standard
    deviation of the regression where that is larger, as beyond the outermost cells.
    """
    with torch.no_grad():
        mean, variance = process(point)
        influence = process.influence(point)
        influence = influence - influence.mean(1, keepdim=True)
        ratio = variance[:, 0].sqrt() / influence.square().sum(1).sqrt().clamp_min(
            1e-30
        )
        influence = influence * ratio.clamp_min(1.0)[:, None]
        return mean + influence.shape[1] * influence


def _nothing(action: Tensor) -> Evaluations:
    raise AssertionError("no evaluation is allowed on given simulations")
