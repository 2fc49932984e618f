"""Search by a regression that is refined where it promises most."""

from __future__ import annotations

from abc import abstractmethod
from typing import NamedTuple

import torch
from torch import Tensor
from typing_extensions import override

from sbi_active.actions import ActionSpace
from sbi_active.search.base import Evaluations, Objective, Search
from sbi_active.search.cube import Coordinates
from sbi_active.seeding import derive_seed

FEWEST = 8  # evaluations
#: Candidates' worth of simulations for each degree of freedom (an entry of a box, a
#: category after the first), and for none.
EACH = 4
MANY = 32  # draws for a permitted point


class Progress(NamedTuple):
    """State of a search.

    Attributes:
        objective: Objective that it maximizes.
        coordinates: Coordinates of the actions.
        found: Evaluations that are numbers.
    """

    objective: Objective
    coordinates: Coordinates
    found: Evaluations


class SequentialSearch(Search):
    """Evaluate actions that fill the space, then those that look best, in rounds.

    Half of a design's simulations are the search's, the others compare its finalists.
    Half of the search's evaluations fill the space.

    Args:
        num_rounds: Rounds after the first.
        num_finalists: Actions to compare in the end.

    Raises:
        ValueError: If either is below 1.
    """

    def __init__(self, *, num_rounds: int = 6, num_finalists: int = 5) -> None:
        if min(num_rounds, num_finalists) < 1:
            raise ValueError(
                "expected num_rounds and num_finalists >= 1; got "
                f"{num_rounds} and {num_finalists}; use about 6 and 5"
            )
        self.num_rounds, self.num_finalists = num_rounds, num_finalists

    @override
    def size(self, actions: ActionSpace) -> int:
        if actions.listed() is not None:
            raise TypeError(
                f"expected BoxActions or MixedActions with a box; got {actions!r}, a "
                "list; use search='exhaustive'"
            )
        coordinates = Coordinates(actions)
        categories = sum(size - 1 for size in coordinates.sizes)
        return EACH * (1 + coordinates.num_continuous + categories)

    @override
    def num_evaluations(self, budget: int, num_samples: int) -> int:
        num = budget // 2 // num_samples
        if num < FEWEST:
            raise ValueError(
                f"expected a budget >= {2 * FEWEST * num_samples}, half of it for "
                f"{FEWEST} actions of {num_samples} simulations; got {budget}; "
                "allow more simulations"
            )
        return num

    @override
    def finalists(self, objective: Objective) -> Tensor:
        coordinates = Coordinates(objective.actions)
        found, left = objective.known, objective.num_evaluations
        if found is None:
            first = permitted_points(objective, coordinates, -(-left // 2), "first")
            found = objective.evaluate(coordinates.actions(first))
            left -= len(first)
        for r in range(self.num_rounds if left > 0 else 0):
            num = left // (self.num_rounds - r)
            if num == 0:
                continue
            left -= num
            progress = Progress(objective, coordinates, found.known())
            action = self._propose(progress, num, r)
            if len(action) == 0:
                break
            found = found.join(objective.evaluate(action))
        progress = Progress(objective, coordinates, found.known())
        return self._best(progress, self.num_finalists)

    @abstractmethod
    def _propose(self, progress: Progress, num: int, index: int) -> Tensor:
        """Return the actions of a round, shape (num, action_dim)."""

    @abstractmethod
    def _best(self, progress: Progress, num: int) -> Tensor:
        """Return the finalists, shape (at most num, action_dim)."""


def permitted_points(
    objective: Objective, coordinates: Coordinates, num: int, key: str
) -> Tensor:
    """Return permitted points that fill the space, shape (num, dim)."""
    seed = derive_seed(objective.seed, key)
    point = coordinates.spread(num, seed)
    inside = objective.permitted(coordinates.actions(point))
    if bool(inside.all()):
        return point
    point = coordinates.spread(MANY * num, seed)
    point = point[objective.permitted(coordinates.actions(point))]
    if len(point) < min(num, FEWEST):
        raise ValueError(
            f"expected a constraint that permits a part of {objective.actions!r}; got "
            f"{len(point)} of {MANY * num} actions; narrow the space to about what "
            "is permitted"
        )
    return point[:num]


def spaced(
    point: Tensor, score: Tensor, num: int, *, num_continuous: int, apart: float
) -> Tensor:
    """Return indices of the best points (n, dim) that are not close to better ones.

    Points of other categories, the entries after the continuous ones, are apart.
    """
    chosen: list[int] = []
    for i in score.argsort(descending=True).tolist():
        if len(chosen) == num:
            break
        others = point[chosen]
        same = (others[:, num_continuous:] == point[i, num_continuous:]).all(1)
        offset = others[:, :num_continuous] - point[i, :num_continuous]
        if not bool((same & (offset.square().sum(1) < apart**2)).any()):
            chosen.append(i)
    return torch.tensor(chosen).long()
