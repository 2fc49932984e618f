"""Beliefs that are the prior times learned factors of all trials.

Here live the product and its samplers. What learns the factors lives in ``trainers``.
"""

from sbi_active.inference.products.belief import sample_product
from sbi_active.inference.products.markov_chains import MarkovChainBelief
from sbi_active.inference.products.product import Product, TrainedRegion, widened

__all__ = [
    "MarkovChainBelief",
    "Product",
    "TrainedRegion",
    "sample_product",
    "widened",
]
