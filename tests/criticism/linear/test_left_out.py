"""Refits without a part of the trials stay within bounds, and are the best there."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sbi_active.criticism.linear.left_out import leave_out
from tests.criticism.linear.linear_models import linear_model


@pytest.fixture
def line():
    """A line through trials of two numbers, the last of which is far away."""
    rng = np.random.default_rng(1)
    x = np.append(rng.normal(size=14), [30.0, 30.0])
    model = linear_model(2 * rng.normal(size=16), np.stack([np.ones(16), x], 1))
    fold = np.repeat(np.arange(8), 2)
    errors = SimpleNamespace(fold=fold, num_folds=8, is_scored=np.ones(16, bool))
    return model, errors


def test_a_trial_that_is_extrapolated_to_counts_in_units_of_what_is_expected(line):
    """Against the plain covariance of a prediction."""
    model, errors = line
    left = leave_out(model, errors)
    assert model.rms > 1
    for j in range(8):
        at = errors.fold == j
        own, rest = model.jacobian[at], model.jacobian[~at]
        cov = np.linalg.inv(rest.T @ rest / model.rms**2 + np.eye(2) / 1e6)
        expected = np.eye(2) + own @ cov @ own.T / model.rms**2
        error = left.error[at]
        square = error @ np.linalg.solve(expected, error) / 2
        assert left.standard[j] == pytest.approx(square, rel=1e-6)
    assert left.standard[-1] < 0.3 * left.square[-1]
    assert (left.standard <= left.square).all()


def test_weights_are_those_of_least_squares(line):
    model, errors = line
    weight = 1.5 + np.sin(errors.fold)
    root = np.sqrt(weight)
    same = replace(
        model, residual=root * model.residual, jacobian=root[:, None] * model.jacobian
    )
    found, plain = leave_out(model, errors, weight=weight), leave_out(same, errors)
    assert found.standard == pytest.approx(plain.standard)
    assert found.refits == pytest.approx(plain.refits)
    assert found.square == pytest.approx(plain.square)


def test_a_coordinate_at_its_bound_is_no_excuse_for_an_error(line):
    """An effect that its bound keeps away leaves errors as they are without it."""
    model, errors = line
    columns = np.column_stack([model.jacobian, -(model.jacobian[:, 1] ** 2)])
    bounds = {"low": np.append(model.low, 0.0), "high": np.append(model.high, 1e-12)}
    wide = linear_model(model.residual, columns, **bounds)
    found = leave_out(wide, errors).standard
    assert found == pytest.approx(leave_out(model, errors).standard, rel=1e-6)
