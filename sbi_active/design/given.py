"""Designs from simulations at hand, such as those that the model was trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.design.coordinates import Coordinates, cells
from sbi_active.design.design import Design
from sbi_active.design.elimination import Race, choose
from sbi_active.design.estimators.automatic import choose_estimator
from sbi_active.design.estimators.base import (
    CandidateSimulations,
    InformationGainEstimator,
)
from sbi_active.design.limits import DesignLimits
from sbi_active.design.search import Evaluations, Objective, Search, presence
from sbi_active.inference.sampling.gaussian_process import GaussianProcess
from sbi_active.seeding import derive_seed
from sbi_active.simulation import Outcome, Simulations
from sbi_active.threads import single_thread

IN_SAMPLE = (
    "estimated on the given simulations: too high where the model was trained on them, "
    "and more so for actions that it overfits"
)


class GivenGains:
    """Estimates without further simulations: half of the rows choose, half report.

    Actions of a list are estimated on their own rows. In a continuous space no two rows
    share an action: contributions of single rows are averaged over cells and a
    regression of the averages gives the estimates, which takes an estimator that scores
    rows one by one.

    Args:
        rows: Simulations at hand.
        estimator: Estimator of the information; None is chosen by what the model says.
        model: Model that the estimator needs.
        belief: Distribution of the parameters.
        limits: Limits and costs of the actions.
        seed: Seed of all draws.
        fewest: Number of rows that a candidate needs.
        num_cells: Number of cells into which the rows of a continuous space are
            averaged.

    Raises:
        TypeError: If the rows are no simulations, or of other actions.
        ValueError: If there is no model.
    """

    def __init__(
        self,
        rows: Simulations,
        estimator: InformationGainEstimator | None,
        model: Any,
        belief: Distribution | None,
        limits: DesignLimits,
        seed: int,
        *,
        fewest: int = 16,
        num_cells: int = 128,
    ) -> None:
        dim = limits.actions.action_dim
        if not isinstance(rows, Simulations) or rows.action.shape[1] != dim:
            raise TypeError(
                f"expected Simulations(theta, action, x) of actions (n, {dim}) for "
                f"simulations=; got {rows!r:.80}; wrap rows of this space in it"
            )
        self.rows, self.model, self.belief = rows, model, belief
        self.limits, self.seed = limits, seed
        self.fewest, self.num_cells = fewest, num_cells
        if estimator is None:
            if model is None:
                raise ValueError(
                    "expected a model with simulations=; got None; pass the trained "
                    "model, or leave out simulations="
                )
            some = self._simulations(torch.arange(len(rows))[:256])
            estimator = choose_estimator(model, some)[0]
        self.estimator = estimator

    def design(self, search: Search) -> Design:
        """Return the design by these rows; nothing is simulated.

        Args:
            search: Search of a space without end.
        """
        listed, notes = self.limits.listed()
        if listed is None:
            return self._of_space(search)
        return self._of_list(listed, notes)

    def _of_list(self, action: Tensor, notes: Sequence[str]) -> Design:
        """Return the design of candidates by their own rows.

        Raises:
            ValueError: If no candidate has rows enough.
        """
        halves: list[list[Tensor]] = [[], []]
        share = torch.full((len(action),), torch.nan, dtype=torch.float64)
        for a, own in enumerate(action):
            near = torch.isclose(self.rows.action, own, rtol=1e-5, atol=1e-7)
            rows = torch.nonzero(near.all(1))[:, 0]
            enough = len(rows) >= self.fewest
            if enough:
                status = self.rows.status[rows]
                known = (status != Outcome.MISSING).sum()
                share[a] = (status == Outcome.OK).sum() / known
            for gains, half in zip(halves, self._split(rows), strict=True):
                gains.append(
                    self._gain(half) if enough else torch.full((2,), torch.nan)
                )
        if bool(share.isnan().all()):
            raise ValueError(
                f"expected simulations with at least {self.fewest} rows of a "
                "candidate; got fewer of every one; pass rows at the actions of the "
                "list"
            )
        return self._chosen(action, halves, share, notes)

    def _of_space(self, search: Search) -> Design:
        """Return the design of the finalists of a search.

        Raises:
            ValueError: If the estimator does not score rows one by one.
        """
        if not self.estimator.rowwise:
            raise ValueError(
                "expected an estimator that scores rows one by one with simulations= "
                f"and continuous actions; got {type(self.estimator).__name__}; use "
                "estimator='posterior', or leave out simulations="
            )
        limits = self.limits
        space = Coordinates(limits.actions)
        everything = torch.arange(len(self.rows))
        averages = [self._averages(space, half) for half in self._split(everything)]
        first, _ = averages[0]
        price = limits.cost(first.action)
        utility, error = first.utility / price, first.standard_error / price
        known = replace(first, utility=utility, standard_error=error)
        objective = Objective(
            actions=limits.actions,
            permitted=limits,
            evaluate=lambda action: known,
            num_evaluations=0,
            seed=derive_seed(self.seed, "search"),
            min_probability_valid=limits.least,
            known=known,
        )
        action = search.finalists(objective)
        point = space.points(action)
        halves, shares = [], []
        for part, num in averages:
            knots = space.points(part.action)
            gain = space.regression(knots, part.utility, part.standard_error)
            halves.append([*_as_contributions(gain, point)])
            valid = presence(space, part, num)
            share = torch.ones(len(point)) if valid is None else valid(point)[0][:, 0]
            shares.append(share.double().clamp(0, 1))
        return self._chosen(action, halves, torch.stack(shares).mean(0))

    def _split(self, rows: Tensor) -> list[Tensor]:
        generator = torch.Generator().manual_seed(derive_seed(self.seed, "split"))
        shuffled = rows[torch.randperm(len(rows), generator=generator)]
        return [*shuffled.tensor_split(2)]

    def _simulations(self, rows: Tensor) -> CandidateSimulations:
        given, action = self.rows, self.rows.action[rows]
        lost = given.status[rows] == Outcome.MISSING
        return CandidateSimulations(
            *(given.theta[rows], action[:1], given.x[rows][None]),
            missing=lost[None],
            each=action,
        )

    def _gain(self, rows: Tensor) -> Tensor:
        """Return contributions of rows, shape (n,)."""
        with single_thread():
            return self.estimator(self.model, self._simulations(rows), self.belief)[0]

    def _averages(self, space: Coordinates, rows: Tensor) -> tuple[Evaluations, Tensor]:
        """Return averages of rows over cells, and the number of rows in each."""
        rows = rows[self.rows.status[rows] != Outcome.MISSING]
        gain = self._gain(rows)
        valid = (self.rows.status[rows] == Outcome.OK).double()
        point = space.points(self.rows.action[rows])
        groups = cells(point, self.num_cells, num_continuous=space.num_continuous)
        averages = Evaluations(
            space.actions(torch.stack([point[g].mean(0) for g in groups])),
            torch.stack([gain[g].mean() for g in groups]),
            torch.stack([gain[g].std() / len(g) ** 0.5 for g in groups]),
            torch.stack([valid[g].mean() for g in groups]),
        )
        return averages, torch.tensor([len(g) for g in groups])

    def _chosen(
        self,
        action: Tensor,
        halves: list[list[Tensor]],
        share: Tensor,
        notes: Sequence[str] = (),
    ) -> Design:
        limits = self.limits
        known = torch.tensor([bool(g.isfinite().any()) for g in halves[0]])
        eligible, cost = known & limits.reached_by(share), limits.cost(action)
        index = torch.nonzero(eligible)[:, 0]
        race = Race.run([halves[0][a] / cost[a] for a in index], self.seed)
        few = int((~known).sum())
        said = [IN_SAMPLE, *limits.excluded_note(eligible | ~known)]
        if few:
            said.append(f"{few} candidates with fewer than {self.fewest} rows excluded")
        return choose(
            limits,
            action=action,
            halves=halves,
            eligible=eligible,
            leader=int(index[race.leader]),
            seed=self.seed,
            probability_valid=share,
            estimator=type(self.estimator).__name__,
            bound="none",  # the model may have seen the rows
            num_simulations=0,
            stopped="simulations given",
            notes=(*said, *notes),
        )


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
        size = influence.square().sum(1).sqrt().clamp_min(1e-30)
        ratio = (variance[:, 0].sqrt() / size).clamp_min(1.0)
        return mean + influence.shape[1] * ratio[:, None] * influence
