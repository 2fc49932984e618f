"""Beliefs that are the prior times learned factors of all trials.

This package contains the product and its samplers. The trainers of the factors are in
``trainers``.
"""

from sbi_active.inference.products.product import Product, TrainedRegion, widened

__all__ = ["Product", "TrainedRegion", "widened"]
