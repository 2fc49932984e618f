"""Learned models as functions of parameters, outcome and action.

This package contains posteriors, likelihoods and ratios. Beliefs, which have seen a
trial, are in ``beliefs``.
"""
