"""Beliefs: distributions over parameters that trials have shaped.

This package contains beliefs that are made of densities or draws alone. Those with a
likelihood are in ``declared`` where it is simulated, and in ``refinement`` where it is
learned.
"""
