"""Which trial has a gross error."""

import numpy as np
import pytest
import torch

from sbi_active.criticism import Trials
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.results import ModelKey
from tests.criticism.steps.linear_world import (
    ACTION,
    NOISE,
    PRIOR,
    judged,
    measured,
    rivals,
)


def found(x, **options):
    trials = Trials(ACTION, x, **options)
    some = RivalSet(rivals(x).model, PRIOR, trials, [])
    return judged(some).states.outliers(ModelKey())


@pytest.mark.parametrize("at", [0, 7])
def test_a_trial_that_is_off_holds_the_probability_under_its_index(at):
    x = measured()
    x[at] += 12 * NOISE
    shares = found(x, index=torch.arange(100, 112))
    assert sum(shares.values()) == pytest.approx(1.0)
    assert next(iter(shares)) == 100 + at
    assert shares[100 + at] > 0.99


def test_a_trial_without_a_measurement_is_none_of_them():
    x = measured()
    x[3] = torch.nan
    assert {*found(x)} == {*np.arange(12.0)} - {3.0}


def test_of_trials_that_agree_none_stands_out():
    shares = found(measured())
    assert [*shares.values()] == sorted(shares.values(), reverse=True)
    assert max(shares.values()) < 0.5
    assert {*shares} == {*np.arange(12.0)}
