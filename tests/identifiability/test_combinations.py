"""Formulas from covariances that are known exactly."""

import numpy as np
import pytest

from sbi_active.identifiability.formula import Combination, Term
from sbi_active.identifiability.search import FormulaSettings, search

NAMES = [*"abcdef"]


def product(*weights, shifts=()):
    shifts = dict(shifts)
    return Combination(
        tuple(
            Term(i, w, log=True, shift=shifts.get(i, 0.0))
            for i, w in enumerate(weights)
        )
    )


@pytest.mark.parametrize(
    ("combination", "text"),
    [
        (product(1, 1), "a * b"),
        (product(1, -1), "a / b"),
        (product(2, -0.5), "a^2 / b^0.5"),
        (product(-1, 1), "1 / a * b"),
        (product(1, 1, shifts={1: 0.5}), "a * (b + 0.5)"),
        (product(1, -1, shifts={0: -0.25}), "(a - 0.25) / b"),
        (Combination((Term(0), Term(1, -0.8))), "a - 0.8 * b"),
        (Combination((Term(0, -1.0), Term(1))), "-a + b"),
        (Combination((Term(0, log=True), Term(1, -2.0))), "a * exp(-2 * b)"),
        (Combination((Term(0), Term(1, log=True))), "b * exp(a)"),
        (Combination(tuple(map(Term, range(5)))), "a + b + c + d + ..."),
        (product(1, 1, 1, 1, 1), "a * b * c * d * ..."),
    ],
)
def test_formulas_read_as_they_compute(combination, text):
    assert combination.text(NAMES) == text
    if "..." in text:
        return
    theta = np.random.default_rng(0).uniform(0.5, 2.0, (7, 2))
    scope = {"a": theta[:, 0], "b": theta[:, 1], "exp": np.exp}
    value = eval(text.replace("^", "**"), scope)
    assert combination.value(theta) == pytest.approx(value)


def gaussian(num, num_trials, seed, sd=0.05):
    """Moments of sums under a linear model; logarithms are not to be had."""
    rng = np.random.default_rng(seed)
    design = rng.standard_normal((num_trials, num))
    covariance = np.linalg.inv(np.eye(num) + design.T @ design / sd**2)

    def moments(terms):
        at = [t.index for t in terms]
        return covariance[np.ix_(at, at)], np.eye(num)[np.ix_(at, at)]

    return moments, covariance


@pytest.mark.parametrize(("num", "share"), [(2, 0.5), (5, 0.9), (12, 0.5), (20, 0.1)])
def test_what_is_found_is_known_and_new(num, share):
    for seed in range(3):
        num_trials = max(int(share * num), 1)
        moments, covariance = gaussian(num, num_trials, seed)
        low, span = np.full(num, -3.0), np.full(num, 6.0)
        found = search(moments, range(num), low, span)
        rows = np.zeros((len(found), num))
        for row, (combination, own) in zip(rows, found, strict=True):
            row[[*combination.index]] = combination.weight
            row /= np.linalg.norm(row)
            assert own == pytest.approx(np.sqrt(row @ covariance @ row), rel=1e-6)
            alone = np.sqrt(covariance.diagonal()[[*combination.index]])
            assert own <= FormulaSettings().known * alone.min()
        assert np.linalg.matrix_rank(rows, tol=1e-4) == len(found) <= num_trials
