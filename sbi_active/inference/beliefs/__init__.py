"""Beliefs: distributions over parameters that trials have shaped.

This package contains beliefs that are made of densities or particles alone. Beliefs
that simulate are in ``refinement``, those of learned factors in ``products``.
"""

from sbi_active.inference.beliefs.belief import ChainedBelief, information_gained
from sbi_active.inference.beliefs.comparison import compare
from sbi_active.inference.beliefs.kernel_belief import KernelBelief

__all__ = [
    "ChainedBelief",
    "KernelBelief",
    "compare",
    "information_gained",
]
