"""Trials that decide: one is chosen, predicted, run, and the verdict asked again.

This package alternates verdicts and trials. How a verdict is reached, and which action
tells most, is in the packages of ``criticism`` that it calls.
"""
