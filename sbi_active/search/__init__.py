"""Searches of an action space, one a file.

Here lives how candidates are proposed for any objective. What the objective is lives in
``information_gain``, who calls both in ``design``.
"""

from sbi_active.search.base import Evaluations, Objective, Search
from sbi_active.search.bayesopt import BayesianOptimization
from sbi_active.search.exhaustive import ExhaustiveSearch
from sbi_active.search.gradient import GradientSearch

__all__ = [
    "BayesianOptimization",
    "Evaluations",
    "ExhaustiveSearch",
    "GradientSearch",
    "Objective",
    "Search",
]
