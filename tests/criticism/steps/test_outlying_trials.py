"""Fitted trials that err far more than the others, where every model misses."""

import numpy as np
import pytest

from sbi_active.criticism.steps.missed_trials import outlying_trials


def test_one_that_errs_ten_times_as_much_is_named():
    squares = np.random.default_rng(0).chisquare(20, 10)
    squares[4] = 100 * np.median(squares)
    ((place, times),) = outlying_trials([*squares])
    assert place == 4
    assert times == pytest.approx(10, rel=0.1)


def test_ordinary_trials_are_rarely_named():
    rng = np.random.default_rng(1)
    named = 0
    for _ in range(1_000):
        spread = 100 * np.exp(rng.normal(0, 1, 10))  # as errors of misfit differ
        named += bool(outlying_trials([*spread]))
    # A hundredth, and its standard error at 1,000 sets is .003.
    assert named / 1_000 < 0.02


def test_few_trials_do_not_show_how_errors_differ():
    assert outlying_trials([1.0, 1.0, 1.0, 1e6]) == []
