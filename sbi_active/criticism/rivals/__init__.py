"""A rival: one simulator with some effects and an error, and its density of trials.

This package contains the coordinates, outcomes and errors of a rival, and its posterior
by sampling. The comparison of rivals is in ``linear`` and ``misfit``.
"""
