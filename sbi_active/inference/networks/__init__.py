"""Networks and what prepares their inputs.

This package contains densities and classifiers of plain tensors, and their training.
Their meaning for an action is in ``models``.
"""
