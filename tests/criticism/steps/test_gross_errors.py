"""Which trial has a gross error."""

import numpy as np
import torch

from sbi_active.criticism import Trials
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.results import ModelKey
from tests.criticism.steps.linear_world import (
    ACTION,
    PRIOR,
    judged,
    measured,
    rivals,
)


def found(x, **options):
    trials = Trials(ACTION, x, **options)
    some = RivalSet(rivals(x).model, PRIOR, trials, [])
    return judged(some).states.outliers(ModelKey())


def test_a_trial_without_a_measurement_is_none_of_them():
    x = measured()
    x[3] = torch.nan
    assert {*found(x)} == {*np.arange(12.0)} - {3.0}
