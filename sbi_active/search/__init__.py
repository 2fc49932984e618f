"""Searches of an action space, one a file.

This package proposes candidates for any objective. The objectives are in
``information_gain``, and the callers of both in ``design``.
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
