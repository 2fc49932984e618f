"""What a verdict rests on."""

import pytest

from sbi_active.criticism.results import OUTLIER, ModelKey
from sbi_active.criticism.steps import influence
from sbi_active.criticism.steps.influence import needed_trials
from tests.criticism.steps.linear_world import measured, rivals

CURVE = ModelKey(("curve",))
REFIT = ModelKey(("curve",), OUTLIER)


@pytest.mark.parametrize(("size", "is_refitted"), [(2.0, False), (0.06, True)])
def test_few_draws_suffice_where_no_trial_can_be_decisive(
    monkeypatch, size, is_refitted
):
    """All counts of draws are called few; only a weak effect asks for more."""
    own = rivals(measured(curve=size))
    exact = needed_trials(own, CURVE)
    monkeypatch.setattr(influence, "FEWEST", 1e9)
    assert needed_trials(own, CURVE) == exact
    assert (REFIT in own.fits) == is_refitted
