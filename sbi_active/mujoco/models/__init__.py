"""Compiled models: their parameters, what changes them, and how they are stepped.

Here lives what knows MuJoCo's ``mjModel`` and nothing of simulators, effects or trials:
numbers go in by name, and what sensors read at every step comes out.
"""
