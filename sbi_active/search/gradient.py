"""Multi-start gradient ascent of a regression of the utility."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from sbi_active.inference.regression.process import IN_CUBE, GaussianProcess
from sbi_active.search.sequential import (
    Progress,
    SequentialSearch,
    permitted_points,
    spaced,
)

NUM_STEPS = 50  # of the ascent
STEP = 0.03  # in the unit cube
RANGE = 0.1  # of the penalty on being close, in the unit cube
#: Largest penalty, in standard deviations of the utility between actions.
REPULSION = 0.3
OPTIMISM = 2.0  # standard deviations of the regression that a proposal may hope for
APART = 0.02  # least distance of actions chosen together, in the unit cube
PENALTY = 10.0  # for a measurement that is too improbable, a unit of probability


class GradientSearch(SequentialSearch):
    r"""Ascend a smooth regression of the utility from many starts.

    The simulator has no gradient, but the contributions to the utility are unbiased at
    every action that was simulated,

    .. math::
        E[\log q(\theta_i | x_i, \xi_i) - \log p(\theta_i) \mid \xi_i] = U(\xi_i),

    so that a regression :math:`\mu(\xi) \pm s(\xi)` of them
    (:class:`.GaussianProcess`) has the gradient that U is lacking; as has
    one of what other estimators give, on common random numbers. Where simulations are
    given and the estimator scores rows one by one, such as the paper's, they are all
    that is needed. Otherwise the utility is evaluated at actions that fill the space,
    at common parameters and with common noise, and then in rounds where

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

    References:
        Klein et al., arXiv 2602.06900 (design by gradients of neural estimates);
        Desautels, Krause & Burdick, JMLR 2014 (batches by upper confidence bounds).
    """

    def __init__(
        self, *, num_rounds: int = 6, num_finalists: int = 5, num_starts: int = 64
    ) -> None:
        super().__init__(num_rounds=num_rounds, num_finalists=num_finalists)
        if num_starts < 1:
            raise ValueError(
                f"expected num_starts >= 1; got {num_starts}; use about 64"
            )
        self.num_starts = num_starts

    def _propose(self, progress: Progress, num: int, index: int) -> Tensor:
        coordinates = progress.coordinates
        score, regression = _score(progress, OPTIMISM)
        point = self._ascend(progress, score, f"round {index}")
        with torch.no_grad():
            covariance = regression.covariance(point)
            best = _batch(
                point, score(point), covariance, num, coordinates.num_continuous
            )
        return coordinates.actions(point[best])

    def _best(self, progress: Progress, num: int) -> Tensor:
        coordinates = progress.coordinates
        score, _ = _score(progress, 0.0)
        point = self._ascend(progress, score, "finalists")
        with torch.no_grad():
            height = score(point)
        c = coordinates.num_continuous
        best = spaced(point, height, num, num_continuous=c, apart=APART)
        return coordinates.actions(point[best])

    def _ascend(
        self,
        progress: Progress,
        score: Callable[[Tensor], Tensor],
        key: str,
    ) -> Tensor:
        """Return permitted points, where ascents started and ended, (s, dim)."""
        objective, coordinates, found = progress
        start = permitted_points(objective, coordinates, self.num_starts, key)
        known = coordinates.points(found.action)
        start = torch.cat([start, known[objective.permitted(found.action)]])
        with torch.enable_grad():
            end = ascend(
                score,
                start,
                num_continuous=coordinates.num_continuous,
                permitted=lambda z: objective.permitted(coordinates.actions(z)),
                repulsion=REPULSION * float(found.utility.std()),
            )
        return torch.cat([end, start])  # an ascent may end lower than it started


def ascend(
    score: Callable[[Tensor], Tensor],
    start: Tensor,
    *,
    num_continuous: int,
    permitted: Callable[[Tensor], Tensor],
    repulsion: float,
) -> Tensor:
    """Return points that rose from permitted starts (s, dim), shape (s, dim).

    Args:
        score: Score of points (s, dim), differentiable in the first entries, shape
            (s,).
        start: Starts, shape (s, dim).
        num_continuous: Entries that move, in a unit cube.
        permitted: Function of points (s, dim) that says which are permitted, shape
            (s,), bool.
        repulsion: The penalty on two points that coincide, in units of the score.
    """
    c = num_continuous
    fixed = start[:, c:]
    other = (fixed[:, None] != fixed[None]).any(-1) | torch.eye(len(start)).bool()
    u = start[:, :c].clone().requires_grad_(True)
    optimizer = torch.optim.Adam([u], lr=STEP)
    for step in range(NUM_STEPS):
        optimizer.zero_grad()
        left = 1 - (step + 1) / NUM_STEPS
        square = (u[:, None] - u[None]).square().sum(-1) / (2 * RANGE**2)
        close = (-square).exp().masked_fill(other, 0.0).sum()
        total = score(torch.cat([u, fixed], 1)).sum() - 0.5 * repulsion * left * close
        (-total).backward()
        before = u.detach().clone()
        optimizer.step()
        with torch.no_grad():
            u.clamp_(0, 1)
            inside = permitted(torch.cat([u, fixed], 1))
            u.copy_(torch.where(inside[:, None], u, before))
        for group in optimizer.param_groups:
            group["lr"] = STEP * (0.1 + 0.9 * left)
    return torch.cat([u.detach(), fixed], 1)


def regression(
    point: Tensor, value: Tensor, error: Tensor, *, num_continuous: int
) -> GaussianProcess:
    """Return a regression of values (n,) on points of a unit cube and categories.

    Args:
        point: Points, shape (n, dim).
        value: Values, shape (n,).
        error: Standard errors of the values, shape (n,).
        num_continuous: Number of entries that are not categories, which come first.
    """
    return GaussianProcess.fit(
        point,
        value[:, None],
        noise=error,
        num_categories=point.shape[1] - num_continuous,
        settings=IN_CUBE,
    )


def _score(
    progress: Progress, optimism: float
) -> tuple[Callable[[Tensor], Tensor], GaussianProcess]:
    """Return the score to ascend, and the regression of the utility in it."""
    objective, coordinates, found = progress
    point = coordinates.points(found.action)
    c = coordinates.num_continuous
    utility = regression(point, found.utility, found.standard_error, num_continuous=c)
    least, share = objective.min_probability_valid, found.probability_valid.double()
    presence = None
    if least > 0 and bool((share < 1).any()):
        error = (share * (1 - share) / 100 + 1e-4).sqrt()
        presence = regression(point, share, error, num_continuous=c)

    def score(z: Tensor) -> Tensor:
        mean, variance = utility(z)
        height = (mean + optimism * variance.sqrt())[:, 0]
        if presence is None:
            return height
        lacking = (least - presence(z)[0][:, 0]).clamp_min(0.0)
        return height - PENALTY * utility.scale[0] * lacking

    return score, utility


def _batch(
    point: Tensor, score: Tensor, covariance: Tensor, num: int, num_continuous: int
) -> Tensor:
    """Return the points of a round, one after the other.

    Each is chosen as if those before had been evaluated: what it may hope for falls
    with the variance that they leave (GP-BUCB). An evaluation beside another, on common
    random numbers, tells nothing new. Of points (m, dim) with scores (m,) that hold
    what may be hoped for, and the regression's covariance (m, m).
    """
    c, least = num_continuous, 1e-6 * float(covariance.diagonal().amax())
    mean = score - OPTIMISM * covariance.diagonal().clamp_min(0.0).sqrt()
    taken = torch.zeros(len(point)).bool()
    chosen: list[int] = []
    while len(chosen) < num and not bool(taken.all()):
        hope = mean + OPTIMISM * covariance.diagonal().clamp_min(0.0).sqrt()
        i = int(hope.masked_fill(taken, -torch.inf).argmax())
        chosen.append(i)
        column = covariance[:, i]
        covariance = covariance - column.outer(column) / (column[i] + least)
        same = (point[:, c:] == point[i, c:]).all(1)
        taken |= same & (torch.cdist(point[:, :c], point[i : i + 1, :c])[:, 0] < APART)
    return torch.tensor(chosen).long()
