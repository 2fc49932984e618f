"""What steps of the loop share: levels, priors, what is equivalent, predictions.

This package contains functions of rivals and trials that return a result. The texts
about results are in ``report``, proposals of trials in ``next_action``.
"""
