"""Designs from simulations at hand, such as those that the model was trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from sbi_active.design.coordinates import Coordinates, cells
from sbi_active.design.design import Design
from sbi_active.design.elimination import Race, choose
from sbi_active.design.estimators.automatic import choose_estimator
from sbi_active.design.estimators.base import (
    CandidateSimulations,
    InformationGainEstimator,
)
from sbi_active.design.problem import DesignProblem
from sbi_active.design.search import Evaluations, Objective
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
        problem: Problem of the design, with the rows.
        fewest: Number of rows that a candidate needs.
        num_cells: Number of cells into which the rows of a continuous space are
            averaged.

    Attributes:
        estimator: Estimator of the information.

    Raises:
        TypeError: If the rows are no simulations.
        ValueError: If they are of other actions, or there is no model.
    """

    def __init__(
        self, problem: DesignProblem, *, fewest: int = 16, num_cells: int = 128
    ) -> None:
        rows, dim = problem.simulations, problem.limits.actions.action_dim
        if not isinstance(rows, Simulations):
            raise TypeError(
                "expected Simulations(theta, action, x) for simulations=; got "
                f"{type(rows).__name__}; wrap the rows in it"
            )
        if rows.action.shape[1] != dim:
            raise ValueError(
                f"expected simulations of actions (n, {dim}); got "
                f"{tuple(rows.action.shape)}; pass those of this space"
            )
        self.problem, self.rows = problem, rows
        self.fewest, self.num_cells = fewest, num_cells
        self.estimator = problem.estimator() or self._by_model()

    def _by_model(self, num_rows: int = 256) -> InformationGainEstimator:
        """Return the estimator by what the model can say of some rows."""
        if self.problem.model is None:
            raise ValueError(
                "expected a model with simulations=; got None; pass the trained model, "
                "or leave out simulations="
            )
        rows = torch.arange(len(self.rows))[:num_rows]
        return choose_estimator(self.problem.model, self._simulations(rows))[0]

    def design(self) -> Design:
        """Return the design by these rows; nothing is simulated."""
        listed, notes = self.problem.limits.listed()
        return self._of_space() if listed is None else self._of_list(listed, notes)

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

    def _of_space(self) -> Design:
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
        limits = self.problem.limits
        space = Coordinates(limits.actions)
        everything = torch.arange(len(self.rows))
        averages = [self._averages(space, half) for half in self._split(everything)]
        first, _ = averages[0]
        price = limits.cost(first.action)
        action = self.problem.search.finalists(
            Objective(
                actions=limits.actions,
                permitted=limits,
                evaluate=_nothing,
                num_evaluations=0,
                seed=derive_seed(self.problem.seed, "search"),
                min_probability_valid=limits.least,
                known=replace(
                    first,
                    utility=first.utility / price,
                    standard_error=first.standard_error / price,
                ),
            )
        )
        point = space.points(action)
        halves, shares = [], []
        for part, num in averages:
            knots = space.points(part.action)
            gain = space.regression(knots, part.utility, part.standard_error)
            halves.append([*_as_contributions(gain, point)])
            valid = part.probability_valid
            share = torch.ones(len(point)).double()
            if bool((valid < 1).any()):
                error = (valid * (1 - valid) / num + 1e-4).sqrt()
                share = space.regression(knots, valid, error)(point)[0][:, 0]
            shares.append(share.clamp(0, 1))
        return self._chosen(action, halves, torch.stack(shares).mean(0))

    def _split(self, rows: Tensor) -> list[Tensor]:
        seed = derive_seed(self.problem.seed, "split")
        generator = torch.Generator().manual_seed(seed)
        shuffled = rows[torch.randperm(len(rows), generator=generator)]
        return [*shuffled.tensor_split(2)]

    def _simulations(self, rows: Tensor) -> RowSimulations:
        given = self.rows
        lost = given.status[rows] == Outcome.MISSING
        return RowSimulations(
            given.theta[rows],
            given.action[rows][:1],
            given.x[rows][None],
            missing=lost[None],
            each=given.action[rows],
        )

    def _gain(self, rows: Tensor) -> Tensor:
        """Return contributions of rows, shape (n,)."""
        problem = self.problem
        with single_thread():
            return self.estimator(
                problem.model, self._simulations(rows), problem.belief
            )[0]

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
        limits, seed = self.problem.limits, self.problem.seed
        known = torch.tensor([bool(g.isfinite().any()) for g in halves[0]])
        eligible, cost = known & limits.reached_by(share), limits.cost(action)
        index = torch.nonzero(eligible)[:, 0]
        race = Race.run([halves[0][a] / cost[a] for a in index], seed)
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
            seed=seed,
            probability_valid=share,
            num_samples=torch.tensor(
                [len(a) + len(b) for a, b in zip(*halves, strict=True)]
            ),
            estimator=type(self.estimator).__name__,
            bound="none",  # the model may have seen the rows
            num_simulations=0,
            stopped="simulations given",
            notes=(*said, *notes),
        )


@dataclass(frozen=True)
class RowSimulations(CandidateSimulations):
    """Rows of which each has an action of its own, for estimators that score rows.

    x has shape (1, n, *x_shape), ``each`` (n, action_dim), and ``action`` is the
    first's.
    """

    each: Tensor = field(default_factory=lambda: torch.empty(0))

    def rows(self) -> tuple[Tensor, Tensor]:
        """Return the parameters, and what was drawn at each."""
        return self.theta, self.each


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


def _nothing(action: Tensor) -> Evaluations:
    raise AssertionError("no evaluation is allowed on given simulations")
