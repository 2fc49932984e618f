"""Beliefs that are the prior times learned factors of all trials.

Here live the product and its samplers. What learns the factors lives in ``trainers``.
"""

from sbi_active.inference.products.product import Product, TrainedRegion, widened

__all__ = ["Product", "TrainedRegion", "widened"]
