"""Beliefs: distributions over parameters that trials have shaped.

Here live those that are made of densities or particles alone. Those that simulate live
in ``refinement``, those of learned factors in ``products``.
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
