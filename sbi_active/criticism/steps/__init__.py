"""The steps of the loop, one a module: detect, trace, combine, predict, evaluate.

This package contains functions of rivals and trials that return a result. The texts
about results are in ``report``, proposals of trials in ``next_trial``.
"""
