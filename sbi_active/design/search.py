"""Searches of an action space: all of a list, or where a regression is largest."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from typing_extensions import override

from sbi_active.actions import ActionSpace
from sbi_active.design.coordinates import Coordinates
from sbi_active.expected import Shown, require_least
from sbi_active.inference.sampling.adam import Adam
from sbi_active.inference.sampling.gaussian_process import GaussianProcess
from sbi_active.seeding import derive_seed

Score = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Evaluations:
    """Estimates of the utility.

    Attributes:
        action: Actions, shape (n, action_dim).
        utility: Expected information gain, by its cost where there is one, shape (n,).
        standard_error: Standard errors, shape (n,).
        probability_valid: Share of simulations with a measurement, shape (n,).
    """

    action: Tensor
    utility: Tensor
    standard_error: Tensor
    probability_valid: Tensor

    def join(self, other: Evaluations) -> Evaluations:
        """Return these and others."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Evaluations(*(torch.cat(pair) for pair in pairs))

    def known(self) -> Evaluations:
        """Return the evaluations that are numbers."""
        keep = self.utility.isfinite() & self.standard_error.isfinite()
        return Evaluations(*(part[keep] for part in vars(self).values()))


@dataclass(frozen=True)
class Objective:
    """The utility that a search maximizes.

    Attributes:
        actions: The space.
        permitted: Function of actions (n, action_dim) that says which may be chosen,
            shape (n,), bool.
        evaluate: Function that simulates actions (k, action_dim), all at the same
            parameters, also from call to call.
        num_evaluations: Actions that may be evaluated.
        seed: Seed of the search's draws.
        min_probability_valid: Share of measurements that a choice needs.
        known: Evaluations to begin with; None for none.
    """

    actions: ActionSpace
    permitted: Callable[[Tensor], Tensor]
    evaluate: Callable[[Tensor], Evaluations]
    num_evaluations: int
    seed: int
    min_probability_valid: float = 0.0
    known: Evaluations | None = None

    @cached_property
    def space(self) -> Coordinates:
        """Actions as points of a unit cube and categories."""
        return Coordinates(self.actions)

    def allows(self, point: Tensor) -> Tensor:
        """Return a mask of permitted points (n, dim), shape (n,), bool."""
        return self.permitted(self.space.actions(point))


class Search(Shown, ABC):
    """Find the actions that deserve an estimate on many simulations."""

    @abstractmethod
    def size(self, actions: ActionSpace) -> int:
        """Return the simulations of a design, in those of one candidate.

        Raises:
            TypeError: If the search does not apply to the space.
        """

    @abstractmethod
    def num_evaluations(self, budget: int, num_samples: int) -> int:
        """Return the number of actions to evaluate on the way.

        Args:
            budget: Simulations of the design.
            num_samples: Simulations of an evaluation.

        Raises:
            ValueError: If the budget does not suffice.
        """

    @abstractmethod
    def finalists(self, objective: Objective) -> Tensor:
        """Return actions, shape (a, action_dim), the best of which is then chosen."""


class ExhaustiveSearch(Search):
    """Compare all actions of a list on common random numbers (:func:`.eliminate`)."""

    @override
    def size(self, actions: ActionSpace) -> int:
        return len(self._listed(actions))

    @override
    def num_evaluations(self, budget: int, num_samples: int) -> int:
        return 0

    @override
    def finalists(self, objective: Objective) -> Tensor:
        values = self._listed(objective.actions)
        return values[objective.permitted(values)]

    @staticmethod
    def _listed(actions: ActionSpace) -> Tensor:
        values = actions.listed()
        if values is None:
            raise TypeError(
                f"expected DiscreteActions; got {type(actions).__name__}, of which "
                "there is no end; list the candidates, DiscreteActions(values), or use "
                "search='gradient'"
            )
        return values


@dataclass(frozen=True, kw_only=True)
class GradientSearch(Search):
    r"""Ascend a smooth regression of the utility from many starts.

    The simulator has no gradient, but the contributions to the utility are unbiased at
    every action that was simulated,

    .. math::
        E[\log q(\theta_i | x_i, \xi_i) - \log p(\theta_i) \mid \xi_i] = U(\xi_i),

    so that a regression :math:`\mu(\xi) \pm s(\xi)` of them (:class:`.GaussianProcess`)
    has the gradient that U is lacking; as has one of what other estimators give, on
    common random numbers. Where simulations are given and the estimator scores rows one
    by one, such as the paper's, they are all that is needed. Otherwise half of a
    design's simulations are the search's, and the others compare its finalists. Half of
    its evaluations fill the space, at common parameters and with common noise; the
    others follow in rounds where

    .. math::
        \mu(\xi_b) + 2 s(\xi_b) - \lambda \sum_{b' \ne b}
        \exp\left(- |\xi_b - \xi_{b'}|^2 / 2 r^2\right)

    is largest; :math:`\lambda`, which keeps the starts apart, falls to zero on the way.
    The actions of a round are chosen from the ends one after the other, each as if
    those before had been evaluated. A point that leaves what is permitted stays where
    it was.

    Args:
        num_rounds: Rounds after the first.
        num_finalists: Actions to compare in the end.
        num_starts: Number of starts of an ascent.
        optimism: Standard deviations of the regression that a proposal may hope for.
        apart: Least distance of actions chosen together, in the unit cube.
        fewest: Number of evaluations that a search needs.
        each: Candidates' worth of simulations for each degree of freedom (an entry of a
            box, a category after the first), and for none.

    Raises:
        ValueError: If a number of rounds, finalists or starts is below 1.

    References:
        Klein et al., arXiv 2602.06900 (design by gradients of neural estimates);
        Desautels, Krause & Burdick, JMLR 2014 (batches by upper confidence bounds).
    """

    num_rounds: int = 6
    num_finalists: int = 5
    num_starts: int = 64
    optimism: float = 2.0
    apart: float = 0.02
    fewest: int = 8
    each: int = 4

    def __post_init__(self) -> None:
        least = {"num_rounds": 1, "num_finalists": 1, "num_starts": 1}
        require_least(self, "use about 6, 5 and 64 of them", **least)

    @override
    def size(self, actions: ActionSpace) -> int:
        if actions.listed() is not None:
            raise TypeError(
                f"expected BoxActions or MixedActions with a box; got {actions!r}, a "
                "list; use search='exhaustive'"
            )
        space = Coordinates(actions)
        categories = sum(size - 1 for size in space.sizes)
        return self.each * (1 + space.num_continuous + categories)

    @override
    def num_evaluations(self, budget: int, num_samples: int) -> int:
        num = budget // 2 // num_samples
        if num < self.fewest:
            raise ValueError(
                f"expected a budget >= {2 * self.fewest * num_samples}, half of it for "
                f"{self.fewest} actions of {num_samples} simulations; got {budget}; "
                "allow more simulations"
            )
        return num

    @override
    def finalists(self, objective: Objective) -> Tensor:
        space = objective.space
        found, left = objective.known, objective.num_evaluations
        if found is None:
            first = self._spread(objective, -(-left // 2), "first")
            found = objective.evaluate(space.actions(first))
            left -= len(first)
        for r in range(self.num_rounds if left > 0 else 0):
            num = left // (self.num_rounds - r)
            if num == 0:
                continue
            left -= num
            point, score, utility = self._ascended(
                objective, found.known(), f"round {r}", self.optimism
            )
            best = self._chosen(space, point, score, utility.covariance(point), num)
            if len(best) == 0:
                break
            found = found.join(objective.evaluate(space.actions(point[best])))
        point, score, _ = self._ascended(objective, found.known(), "finalists", 0.0)
        none = torch.zeros(len(point), len(point)).double()
        best = self._chosen(space, point, score, none, self.num_finalists)
        return space.actions(point[best])

    def _spread(self, objective: Objective, num: int, key: str) -> Tensor:
        """Return permitted points that fill the space, shape (num, dim)."""
        seed = derive_seed(objective.seed, key)
        point = objective.space.spread(num, seed)
        if bool(objective.allows(point).all()):
            return point
        drawn = objective.space.spread(32 * num, seed)
        point = drawn[objective.allows(drawn)]
        if len(point) < min(num, self.fewest):
            raise ValueError(
                f"expected a constraint that permits a part of {objective.actions!r}; "
                f"got {len(point)} of {len(drawn)} actions; narrow the space to about "
                "what is permitted"
            )
        return point[:num]

    def _ascended(
        self, objective: Objective, found: Evaluations, key: str, optimism: float
    ) -> tuple[Tensor, Tensor, GaussianProcess]:
        """Return permitted points (s, dim), where ascents started and ended.

        Beside them are their scores (s,), and the regression of the utility.
        """
        score, utility = _score(objective, found, optimism)
        known = objective.space.points(found.action)
        known = known[objective.permitted(found.action)]
        start = torch.cat([self._spread(objective, self.num_starts, key), known])
        with torch.enable_grad():
            end = ascend(score, start, objective, 0.3 * float(found.utility.std()))
        point = torch.cat([end, start])  # an ascent may end lower than it started
        with torch.no_grad():
            return point, score(point), utility

    def _chosen(
        self,
        space: Coordinates,
        point: Tensor,
        score: Tensor,
        covariance: Tensor,
        num: int,
    ) -> Tensor:
        """Return indices of the best points, one after the other, none close to others.

        Each is chosen as if those before had been evaluated: what it may hope for falls
        with the variance that they leave (GP-BUCB). An evaluation beside another, on
        common random numbers, tells nothing new. Of points (m, dim) with scores (m,)
        that hold what may be hoped for, and the regression's covariance (m, m), zero
        where nothing is hoped for.
        """

        def hope() -> Tensor:
            return self.optimism * covariance.diagonal().clamp_min(0.0).sqrt()

        least = 1e-6 * float(covariance.diagonal().amax()) or 1.0
        mean = score - hope()
        taken = torch.zeros(len(point)).bool()
        chosen: list[int] = []
        while len(chosen) < num and not bool(taken.all()):
            i = int((mean + hope()).masked_fill(taken, -torch.inf).argmax())
            chosen.append(i)
            column = covariance[:, i]
            covariance = covariance - column.outer(column) / (column[i] + least)
            taken |= space.distance(point, point[i]) < self.apart
        return torch.tensor(chosen).long()


def ascend(
    score: Score,
    start: Tensor,
    objective: Objective,
    repulsion: float,
    *,
    num_steps: int = 50,
    step: float = 0.03,
    reach: float = 0.1,
) -> Tensor:
    """Return points that rose from permitted starts (s, dim), shape (s, dim).

    Args:
        score: Score of points (s, dim), differentiable in the first entries, shape
            (s,).
        start: Starts, shape (s, dim).
        objective: Objective that says which points are permitted.
        repulsion: The penalty on two points that coincide, in units of the score.
        num_steps: Number of steps.
        step: Length of the first steps.
        reach: Distance at which the penalty has fallen to .6.
    """
    c = objective.space.num_continuous
    fixed = start[:, c:]
    other = (fixed[:, None] != fixed[None]).any(-1) | torch.eye(len(start)).bool()
    u = start[:, :c].clone().requires_grad_(True)
    optimizer = Adam([u], rate=step)
    for k in range(num_steps):
        optimizer.forget_gradients()
        left = 1 - (k + 1) / num_steps
        square = (u[:, None] - u[None]).square().sum(-1) / (2 * reach**2)
        close = (-square).exp().masked_fill(other, 0.0).sum()
        total = score(torch.cat([u, fixed], 1)).sum() - 0.5 * repulsion * left * close
        (-total).backward()
        before = u.detach().clone()
        optimizer.step()
        with torch.no_grad():
            u.clamp_(0, 1)
            inside = objective.allows(torch.cat([u, fixed], 1))
            u.copy_(torch.where(inside[:, None], u, before))
        optimizer.rate = step * (0.1 + 0.9 * left)
    return torch.cat([u.detach(), fixed], 1)


def presence(
    space: Coordinates, found: Evaluations, num: Tensor | float
) -> GaussianProcess | None:
    """Return a regression of the probability of a measurement; None where it is 1.

    Args:
        space: Space of the actions.
        found: Evaluations with shares of measurements.
        num: Number of simulations behind each share.
    """
    share = found.probability_valid.double()
    if bool((share == 1).all()):
        return None
    error = (share * (1 - share) / num + 1e-4).sqrt()
    return space.regression(space.points(found.action), share, error)


def _score(
    objective: Objective, found: Evaluations, optimism: float, *, penalty: float = 10.0
) -> tuple[Score, GaussianProcess]:
    """Return the score to ascend, and the regression of the utility in it.

    The penalty is on a measurement that is too improbable, a unit of probability.
    """
    space, least = objective.space, objective.min_probability_valid
    point = space.points(found.action)
    utility = space.regression(point, found.utility, found.standard_error)
    valid = presence(space, found, 100) if least > 0 else None

    def score(z: Tensor) -> Tensor:
        mean, variance = utility(z)
        height = (mean + optimism * variance.sqrt())[:, 0]
        if valid is None:
            return height
        lacking = (least - valid(z)[0][:, 0]).clamp_min(0.0)
        return height - penalty * utility.scale[0] * lacking

    return score, utility
