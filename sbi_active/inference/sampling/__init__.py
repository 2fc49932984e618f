"""Samplers and proposals over the parameters' unbounded coordinates.

This package contains tools that know a density, or a function's values, and nothing of
trials, networks or simulators.
"""
