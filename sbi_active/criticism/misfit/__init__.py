"""Verdicts when every model is wrong: one evidence, left-out trials, what remains.

This package contains linearized models, the errors that all of them share, and the rule
that selects helpful effects and names causes. The samplers of a posterior are in
``evidence``.
"""
