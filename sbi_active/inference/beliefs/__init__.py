"""Beliefs: distributions over parameters that trials have shaped.

This package contains beliefs that are made of densities or particles alone. Beliefs
that simulate are in ``refinement``, those of learned factors in ``products``.
"""
