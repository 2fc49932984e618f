"""Rows of a round: simulations, what they are conditioned on, what sbi is given.

This package contains the shapes and checks that all trainers share. It does not learn.
"""
