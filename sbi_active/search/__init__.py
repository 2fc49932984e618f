"""Searches of an action space, one a file."""

from sbi_active.search.base import Evaluations, Objective, Search
from sbi_active.search.bayesopt import BayesianOptimization
from sbi_active.search.exhaustive import ExhaustiveSearch
from sbi_active.search.gradient import GradientSearch
from sbi_active.search.surrogate import Surrogate

__all__ = [
    "BayesianOptimization",
    "Evaluations",
    "ExhaustiveSearch",
    "GradientSearch",
    "Objective",
    "Search",
    "Surrogate",
]
