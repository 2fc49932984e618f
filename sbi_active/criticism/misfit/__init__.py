"""Verdicts: one rule, the draws and errors behind it, what speaks against it.

This package contains the rule that selects helpful effects and names causes, and the
results that follow from it. Fits are in ``linear``, samplers in ``rivals``.
"""
