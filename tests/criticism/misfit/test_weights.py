"""Weights of models by their errors on left-out trials."""

import numpy as np
import pytest

from sbi_active.criticism.misfit.scored import weights_by_error
from sbi_active.criticism.results import ModelKey

BARE, ONE, TWO = ModelKey(), ModelKey(("one",)), ModelKey(("two",))
EQUAL = {BARE: 0.0, ONE: 0.0, TWO: 0.0}


def test_each_part_counts_as_one_number_with_an_error_of_unknown_size():
    error = {BARE: np.full(10, 4.0), ONE: np.full(10, 2.0), TWO: np.full(10, 2.0)}
    found = weights_by_error(error, EQUAL, seed=0)
    assert found[ONE] == pytest.approx(found[TWO])
    assert found[ONE] / found[BARE] == pytest.approx(2.0**5)
    assert [*found][-1] == BARE
    assert sum(found.values()) == pytest.approx(1.0)


def test_prior_probabilities_count():
    error = {BARE: np.full(10, 2.0), ONE: np.full(10, 2.0)}
    found = weights_by_error(error, {BARE: np.log(3.0), ONE: 0.0}, seed=0)
    assert found[BARE] == pytest.approx(0.75)


def test_no_model_wins_by_one_part_alone():
    """At the errors' mean the weight would be 1 / (1 + 1.9^-3.5) = .90."""
    error = {BARE: np.r_[np.ones(6), 8.0], ONE: np.r_[np.full(6, 1.05), 1.0]}
    of_the_mean = 1 / (1 + (error[ONE].mean() / error[BARE].mean()) ** 3.5)
    found = weights_by_error(error, {BARE: 0.0, ONE: 0.0}, seed=0)
    assert 0.5 < found[ONE] < of_the_mean - 0.05


def test_parts_that_do_not_count_change_nothing():
    error = {BARE: np.array([1.0, 2.0, 3.0]), ONE: np.array([2.0, 1.0, 2.0])}
    more = {key: np.r_[np.nan, square] for key, square in error.items()}
    one = weights_by_error(error, EQUAL, seed=0)
    assert weights_by_error(more, EQUAL, seed=0) == one
