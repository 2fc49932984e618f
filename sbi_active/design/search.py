"""Searches of an action space for where a regression of the utility is largest."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import torch
from attrs import frozen
from scipy.optimize import minimize
from torch import Tensor
from typing_extensions import override

from sbi_active.actions import ActionSpace
from sbi_active.arrays import Array
from sbi_active.design.coordinates import Coordinates
from sbi_active.expected import Shown, require
from sbi_active.inference.sampling.gaussian_process import IN_CUBE, GaussianProcess
from sbi_active.seeding import derive_seed

Score = Callable[[Tensor], Tensor]


class Evaluations(NamedTuple):
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
        return Evaluations(*map(torch.cat, zip(self, other, strict=True)))

    def known(self) -> Evaluations:
        """Return the evaluations that are numbers."""
        keep = self.utility.isfinite() & self.standard_error.isfinite()
        return Evaluations(*(part[keep] for part in self))


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
    """

    actions: ActionSpace
    permitted: Callable[[Tensor], Tensor]
    evaluate: Callable[[Tensor], Evaluations]
    num_evaluations: int
    seed: int
    min_probability_valid: float = 0.0

    @cached_property
    def space(self) -> Coordinates:
        """Actions as points of a unit cube and categories."""
        return Coordinates(self.actions)

    def allows(self, point: Tensor) -> Tensor:
        """Return a mask of permitted points (n, dim), shape (n,), bool."""
        return self.permitted(self.space.actions(point))


class Search(Shown, ABC):
    """Find the actions that deserve an estimate, in a space that is no list.

    Attributes:
        negligible: Expected loss at which the choice among its finalists ends, nats.
            They differ by less than actions of a list: with .05, as there, six times as
            much was lost, and .001 saves nothing more.
    """

    negligible: ClassVar[float] = 0.003

    @abstractmethod
    def size(self, actions: ActionSpace) -> int:
        """Return the simulations of a design, in those of one candidate."""

    def num_evaluations(self, budget: int, num_samples: int) -> int:
        """Return the number of actions to evaluate on the way, 0 by default.

        Args:
            budget: Simulations of the design.
            num_samples: Simulations of an evaluation.

        Raises:
            ValueError: If the budget does not suffice.
        """
        return 0

    @abstractmethod
    def finalists(self, objective: Objective) -> Tensor:
        """Return actions, shape (a, action_dim), the best of which is then chosen."""


@frozen(slots=False)
class GradientSearch(Search):
    r"""Ascend a smooth regression of the utility from many starts.

    The simulator has no gradient, but the contributions to the utility are unbiased at
    every action that was simulated,

    .. math::
        E[\log q(\theta_i | x_i, \xi_i) - \log p(\theta_i) \mid \xi_i] = U(\xi_i),

    so that a regression :math:`\mu(\xi) \pm s(\xi)` of them (:class:`.GaussianProcess`)
    has the gradient that U is lacking; as has one of what other estimators give, on
    common random numbers. Half of a design's simulations are the search's, and the
    others compare its finalists. Half of its evaluations fill the space, each the
    farthest from those before, at common parameters and with common noise; the others
    follow in rounds where :math:`\mu(\xi) + 4 s(\xi)` is largest. The actions of a
    round are chosen from the ends one after the other, each as if those before had been
    evaluated. A point that leaves what is permitted goes back to its edge.

    Attributes:
        num_rounds: Rounds after the first.
        num_finalists: Actions to compare in the end.
        num_starts: Number of starts of an ascent.
        optimism: Standard deviations of the regression that a proposal may hope for.
            With half as many the later rounds stay where the best is known, and one of
            forty narrow optima was missed.
        apart: Least distance of actions chosen together, in the unit cube.
        penalty: Deviations of the utility that an action loses for a measurement that
            is too improbable, a unit of probability.
        fewest: Number of evaluations that a search needs.
        choice: Draws for each point that fills the space. A quarter leaves larger
            holes.
        each: Candidates' worth of simulations for each degree of freedom (an entry of a
            box, a category after the first), and for none.

    References:
        Klein et al., arXiv 2602.06900 (design by gradients of neural estimates);
        Desautels, Krause & Burdick, JMLR 2014 (batches by upper confidence bounds).
    """

    num_rounds: ClassVar[int] = 6
    num_finalists: ClassVar[int] = 5
    num_starts: ClassVar[int] = 64
    optimism: ClassVar[float] = 4.0
    apart: ClassVar[float] = 0.02
    penalty: ClassVar[float] = 10.0
    fewest: ClassVar[int] = 8
    each: ClassVar[int] = 4
    choice: ClassVar[int] = 32

    @override
    def size(self, actions: ActionSpace) -> int:
        space = Coordinates(actions)
        categories = sum(size - 1 for size in space.sizes)
        return self.each * (1 + space.num_continuous + categories)

    @override
    def num_evaluations(self, budget: int, num_samples: int) -> int:
        num = budget // 2 // num_samples
        least = f"a budget >= {2 * self.fewest * num_samples}, half of it for "
        least += f"{self.fewest} actions of {num_samples} simulations"
        require(num >= self.fewest, least, budget, "allow more simulations")
        return num

    @override
    def finalists(self, objective: Objective) -> Tensor:
        space = objective.space
        first = self._spread(objective, -(-objective.num_evaluations // 2), "first")
        found = objective.evaluate(space.actions(first))
        left = objective.num_evaluations - len(first)
        for r in range(self.num_rounds):
            num = left // (self.num_rounds - r)
            if num == 0:
                continue
            left -= num
            known, key = found.known(), f"round {r}"
            best = self._best(objective, known, key, num, self.optimism)
            found = found.join(objective.evaluate(space.actions(best)))
        known, num = found.known(), self.num_finalists
        return space.actions(self._best(objective, known, "finalists", num, 0.0))

    def _spread(self, objective: Objective, num: int, key: str) -> Tensor:
        """Return permitted points that fill the space, shape (num, dim)."""
        space = objective.space
        drawn = space.drawn(self.choice * num, derive_seed(objective.seed, key))
        point = drawn[objective.allows(drawn)]
        enough = len(point) >= min(num, self.fewest)
        expected = f"a constraint that permits a part of {objective.actions!r}"
        got = f"{len(point)} of {len(drawn)} actions"
        require(enough, expected, got, "narrow the space to about what it permits")
        return space.filling(point, num)

    def _best(
        self,
        objective: Objective,
        found: Evaluations,
        key: str,
        num: int,
        optimism: float,
    ) -> Tensor:
        """Return permitted points (num, dim) to hope most for, none close to others.

        They are where ascents started or ended. Each is chosen as if those before had
        been evaluated: what it may hope for falls with the variance that they leave
        (GP-BUCB). An evaluation beside another, on common random numbers, tells nothing
        new.
        """
        space, utility = objective.space, self._regression(objective, found)

        def score(z: Tensor) -> Tensor:
            mean, variance = utility(z)
            return (mean + optimism * variance.sqrt())[:, 0]

        known = space.points(found.action)[objective.permitted(found.action)]
        start = torch.cat([self._spread(objective, self.num_starts, key), known])
        # An ascent may end lower than it started.
        point = torch.cat([ascended(score, start, objective), start])
        with torch.no_grad():
            mean = utility(point)[0][:, 0]
        covariance = utility.covariance(point)
        least = 1e-6 * float(covariance.diagonal().amax()) or 1.0
        taken = torch.zeros(len(point)).bool()
        chosen: list[int] = []
        while len(chosen) < num and not bool(taken.all()):
            hope = mean + optimism * covariance.diagonal().clamp_min(0.0).sqrt()
            i = int(hope.masked_fill(taken, -torch.inf).argmax())
            chosen.append(i)
            column = covariance[:, i]
            covariance = covariance - column.outer(column) / (column[i] + least)
            taken |= space.distance(point, point[i]) < self.apart
        return point[chosen]

    def _regression(self, objective: Objective, found: Evaluations) -> GaussianProcess:
        """Return the regression of the utility, less what is measured too seldom."""
        space, least = objective.space, objective.min_probability_valid
        lacking = (least - found.probability_valid).clamp_min(0.0)
        value = found.utility - self.penalty * found.utility.std() * lacking
        return GaussianProcess.fit(
            space.points(found.action),
            value[:, None],
            noise=found.standard_error,
            num_categories=len(space.sizes),
            settings=IN_CUBE,
        )


def ascended(
    score: Score, start: Tensor, objective: Objective, *, num_steps: int = 20
) -> Tensor:
    """Return points that rose from permitted starts (s, dim), shape (s, dim).

    A point that left what is permitted goes back to its edge, on the line to its start.

    Args:
        score: Score of points (s, dim), differentiable in the first entries, shape
            (s,).
        start: Starts.
        objective: Objective that says which points are permitted.
        num_steps: Number of steps.
    """
    c = objective.space.num_continuous
    fixed = start[:, c:]

    def fall(flat: Array) -> tuple[float, Array]:
        u = torch.tensor(flat.reshape(-1, c), requires_grad=True)
        total = -score(torch.cat([u, fixed], 1)).sum()
        return float(total.detach()), torch.autograd.grad(total, u)[0].flatten().numpy()

    first = start[:, :c].flatten().numpy()
    with torch.enable_grad():
        inside, steps = [(0.0, 1.0)] * len(first), {"maxiter": num_steps}
        limits = {"bounds": inside, "options": steps}
        found = minimize(fall, first, jac=True, method="L-BFGS-B", **limits)
    end = torch.cat([torch.from_numpy(found.x).reshape(-1, c), fixed], 1)
    inside = torch.where(objective.allows(end)[:, None], end, start)
    for _ in range(10):  # a thousandth of the way
        middle = 0.5 * (inside + end)
        allowed = objective.allows(middle)[:, None]
        inside = torch.where(allowed, middle, inside)
        end = torch.where(allowed, end, middle)
    return inside
