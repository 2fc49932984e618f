"""Formulas from covariances that are known exactly."""

import numpy as np
import pytest

from sbi_active.identifiability.formula import Combination, Term

NAMES = [*"abcdef"]


def product(*weights, shifts=()):
    shifts = dict(shifts)
    shift = [shifts.get(i, 0.0) for i in range(len(weights))]
    terms = zip(range(len(weights)), weights, shift, strict=True)
    return Combination(tuple(Term(i, w, log=True, shift=s) for i, w, s in terms))


@pytest.mark.parametrize(
    ("combination", "text"),
    [
        (product(2, -0.5), "a^2 / b^0.5"),
        (product(-1, 1), "1 / a * b"),
        (product(1, -1, shifts={0: -0.25}), "(a - 0.25) / b"),
        (Combination((Term(0), Term(1, -0.8))), "a - 0.8 * b"),
        (Combination((Term(0, -1.0), Term(1))), "-a + b"),
        (Combination((Term(0, log=True), Term(1, -2.0))), "a * exp(-2 * b)"),
        (Combination((Term(0), Term(1, log=True))), "b * exp(a)"),
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
