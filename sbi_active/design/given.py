"""Designs from simulations at hand, such as those that the model was trained on."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.design.coordinates import Coordinates
from sbi_active.design.design import Design
from sbi_active.design.elimination import Race, choose
from sbi_active.design.estimators.automatic import choose_estimator
from sbi_active.design.estimators.base import (
    CandidateSimulations,
    InformationGainEstimator,
    standard_error,
)
from sbi_active.design.limits import DesignLimits
from sbi_active.design.search import Evaluations, Objective, Search
from sbi_active.seeding import derive_seed
from sbi_active.simulation import Outcome, Simulations
from sbi_active.threads import single_thread

IN_SAMPLE = (
    "estimated on the given simulations: too high where the model was trained on them, "
    "and more so for actions that it overfits"
)


class GivenGains:
    """Estimates without further simulations: half of the rows choose, half report.

    An action of a list is estimated on its own rows, and one of a space without end,
    where no two rows share an action, on the rows nearest to it. This takes an
    estimator that scores rows one by one.

    Args:
        rows: Simulations at hand.
        estimator: Estimator of the information; None is chosen by what the model says.
        model: Model that the estimator needs.
        belief: Distribution of the parameters.
        limits: Limits and costs of the actions.
        seed: Seed of all draws.
        fewest: Number of rows that a candidate needs.
        num_near: Number of the nearest rows of a half; of a quarter the standard error
            is twice as large, of four times as many a peak is as much flatter.
        num_evaluations: Number of actions that a search evaluates.

    Raises:
        TypeError: If the rows are no simulations, or of other actions.
        ValueError: If there is no model, or the estimator does not score rows one by
            one in a space without end.
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
        num_near: int = 64,
        num_evaluations: int = 64,
    ) -> None:
        dim = limits.actions.action_dim
        if not isinstance(rows, Simulations) or rows.action.shape[1] != dim:
            raise TypeError(
                f"expected Simulations(theta, action, x) of actions (n, {dim}) for "
                f"simulations=; got {rows!r:.80}; wrap rows of this space in it"
            )
        self.rows, self.model, self.belief = rows, model, belief
        self.limits, self.seed, self.fewest = limits, seed, fewest
        self.num_near, self.num_evaluations = num_near, num_evaluations
        if estimator is None:
            if model is None:
                raise ValueError(
                    "expected a model with simulations=; got None; pass the trained "
                    "model, or leave out simulations="
                )
            some = self._simulations(torch.arange(len(rows))[:256])
            estimator = choose_estimator(model, some)[0]
        self.estimator = estimator
        is_listed = limits.actions.listed() is not None
        self._space = None if is_listed else Coordinates(limits.actions)
        if not is_listed and not estimator.rowwise:
            raise ValueError(
                "expected an estimator that scores rows one by one with simulations= "
                f"and continuous actions; got {type(estimator).__name__}; use "
                "estimator='posterior', or leave out simulations="
            )

    def design(self, search: Search) -> Design:
        """Return the design by these rows; nothing is simulated.

        Args:
            search: Search of a space without end.

        Raises:
            ValueError: If no candidate has rows enough.
        """
        limits = self.limits
        action, notes = limits.listed()
        if action is None:
            action = search.finalists(self._objective())
        rows = [self._rows_at(own) for own in action]
        known = torch.tensor([len(own) >= self.fewest for own in rows])
        if not bool(known.any()):
            raise ValueError(
                f"expected simulations with at least {self.fewest} rows of a "
                "candidate; got fewer of every one; pass rows at the actions of the "
                "list"
            )
        halves = [[self._gain(own, k) for own in rows] for k in range(2)]
        share = torch.stack([self._share_valid(own) for own in rows])
        eligible, cost = known & limits.reached_by(share), limits.cost(action)
        index = torch.nonzero(eligible)[:, 0]
        race = Race.run([halves[0][a] / cost[a] for a in index], self.seed)
        said = [IN_SAMPLE, *limits.excluded_note(eligible | ~known)]
        if few := int((~known).sum()):
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

    def _objective(self) -> Objective:
        """Return the utility at actions of a space without end, by half of the rows."""
        limits = self.limits

        def evaluate(action: Tensor) -> Evaluations:
            rows = [self._rows_at(own) for own in action]
            gains, cost = [self._gain(own, 0) for own in rows], limits.cost(action)
            return Evaluations(
                action,
                torch.stack([gain.nanmean() for gain in gains]) / cost,
                torch.stack([standard_error(gain) for gain in gains]) / cost,
                torch.stack([self._share_valid(own) for own in rows]),
            )

        return Objective(
            actions=limits.actions,
            permitted=limits,
            evaluate=evaluate,
            num_evaluations=self.num_evaluations,
            seed=derive_seed(self.seed, "search"),
            min_probability_valid=limits.least,
        )

    def _rows_at(self, action: Tensor) -> Tensor:
        """Return the rows at an action of a list, or those nearest to one, (k,)."""
        if self._space is None:
            near = torch.isclose(self.rows.action, action, rtol=1e-5, atol=1e-7)
            return torch.nonzero(near.all(1))[:, 0]
        point = self._space.points(torch.cat([action[None], self.rows.action]))
        apart = self._space.distance(point[1:], point[0])
        order = apart.argsort(stable=True)[: 2 * self.num_near]
        return order[apart[order].isfinite()]

    def _share_valid(self, rows: Tensor) -> Tensor:
        """Return the share of rows with a measurement, NaN where too few are known."""
        status = self.rows.status[rows]
        known = status[status != Outcome.MISSING]
        if len(rows) < self.fewest:
            return torch.tensor(torch.nan, dtype=torch.float64)
        return (known == Outcome.OK).double().mean()

    def _simulations(self, rows: Tensor) -> CandidateSimulations:
        given, action = self.rows, self.rows.action[rows]
        lost = given.status[rows] == Outcome.MISSING
        return CandidateSimulations(
            *(given.theta[rows], action[:1], given.x[rows][None]),
            missing=lost[None],
            each=action,
        )

    def _gain(self, rows: Tensor, half: int) -> Tensor:
        """Return contributions of half of the rows, (n,); NaN where these are few."""
        if len(rows) < self.fewest:
            return torch.full((2,), torch.nan)
        given = self._simulations(rows[half::2])
        with single_thread():
            return self.estimator(self.model, given, self.belief)[0]
