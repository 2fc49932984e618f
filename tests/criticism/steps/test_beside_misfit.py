"""Predictions where every model misses: those of the linear model that was fitted."""

import pytest

from sbi_active.criticism import Criticism
from sbi_active.criticism.steps.predictive import find_residuals
from tests.criticism.misfit.oscillator import EFFECTS, MODEL, PRIOR, trials


@pytest.fixture(scope="module")
def compared():
    found = Criticism(MODEL, PRIOR, trials(lag=0.3, hidden=0.6), effects=EFFECTS)
    assert found.trace().misfit is not None
    return found


def test_residuals_are_those_of_the_best_fit(compared):
    """Draws as wide as the misfit leave the valley that parameters make up for."""
    key, search = compared.trace().key, compared.misfit().search
    left = find_residuals(compared.rivals, key)
    own = (left.x - left.mean).ravel()[search.errors.measurements.position]
    assert own == pytest.approx(search.unit * search.model(key).residual, abs=1e-6)
