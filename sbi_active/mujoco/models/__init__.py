"""Compiled models: their parameters, what changes them, and how they are stepped.

This package knows MuJoCo's ``mjModel`` and nothing of simulators, effects or trials:
numbers go in by name, and the sensors' readings at every step come out.
"""
