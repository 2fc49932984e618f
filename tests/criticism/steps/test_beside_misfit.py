"""Predictions where every model misses: those of the linear model that was fitted."""

import numpy as np
import pytest

from sbi_active.criticism import Criticism
from sbi_active.criticism.misfit.draws import spread_of
from sbi_active.criticism.steps.predictive import find_residuals, predict
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


def test_predictions_are_as_wide_as_left_out_errors_say(compared):
    key, found = compared.trace().key, compared.misfit()
    model, errors, num = found.model(key), found.search.errors, 2_000
    rows = found.search.unit[:, None] * model.rows[: model.num, 1:]
    spread = spread_of(found, key)
    variance = ((rows @ found.covariance(key)) * rows).sum(1)
    size = spread.size[errors.measurements.channel]
    prediction = predict(compared.rivals, key=key, num_draws=num)
    expected = spread.scale * np.sqrt(variance + size**2)
    # Four errors of a deviation, and the bend within a tenth of it.
    assert prediction.moments()[1] == pytest.approx(expected, rel=4 / np.sqrt(2 * num))
    left = found.search.found[key].left.error * found.search.unit
    ratio = left**2 / (variance + size**2)
    parts = [ratio[errors.fold == f].mean() for f in range(errors.num_folds)]
    assert spread.square == pytest.approx(np.array(parts))
    assert spread.scale**2 == pytest.approx(np.mean(parts))
