"""All actions of a list."""

from __future__ import annotations

from torch import Tensor
from typing_extensions import override

from sbi_active.actions import ActionSpace
from sbi_active.search.base import Objective, Search


class ExhaustiveSearch(Search):
    """Compare all actions of a list.

    They are compared by :func:`.eliminate`, on common random numbers.
    """

    @override
    def size(self, actions: ActionSpace) -> int:
        return len(_listed(actions))

    @override
    def num_evaluations(self, budget: int, num_samples: int) -> int:
        return 0

    @override
    def finalists(self, objective: Objective) -> Tensor:
        values = _listed(objective.actions)
        return values[objective.permitted(values)]


def _listed(actions: ActionSpace) -> Tensor:
    values = actions.listed()
    if values is None:
        raise TypeError(
            f"expected DiscreteActions; got {type(actions).__name__}, of which there "
            "is no end; list the candidates, DiscreteActions(values), or use "
            "search='gradient'"
        )
    return values
