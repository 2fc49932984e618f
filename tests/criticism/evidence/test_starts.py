"""Where the search for a larger rival starts."""

import numpy as np
import pytest

from sbi_active.criticism.evidence.starts import NUM_NEAR, starts_near_parents
from sbi_active.criticism.results import ModelKey
from tests.criticism.steps.linear_world import measured, posterior, rivals

X = measured(curve=0.5, kink=0.6)
CURVE, KINK = ModelKey(("curve",)), ModelKey(("kink",))
BOTH = ModelKey(("curve", "kink"))


def starts(key, *, fitted):
    some = rivals(X)
    for parent in fitted:
        some.fit(parent)
    rival = some.rival(key)
    u = starts_near_parents(some.fits, rival, 0)
    return None if u is None else rival.coordinates.to_z(u)


def test_without_a_parent_there_are_none():
    assert starts(BOTH, fitted=[ModelKey(), ModelKey(("wave",))]) is None
    assert starts(ModelKey(), fitted=[ModelKey()]) is None


def test_parameters_and_strengths_are_those_of_the_parents():
    z = starts(BOTH, fitted=[CURVE, KINK])
    assert len(z) == NUM_NEAR
    half = NUM_NEAR // 2
    # The parent without the curve has the kink, and so on, each in its own place.
    for rows, names, known, drawn in (
        (z[:half], ("kink",), [0, 1, 3], 2),
        (z[half:], ("curve",), [0, 1, 2], 3),
    ):
        mean, covariance = posterior(X, names)
        distance = abs(rows[:, known] - mean) / np.sqrt(np.diag(covariance))
        assert distance.max() < 5
        # The effect that it has not comes from the prior, of deviation 1.
        assert rows[:, drawn].std() > 0.2


@pytest.mark.parametrize("error", ["unexplained", "scatter"])
def test_behind_a_catch_all_it_is_the_bare_model(error):
    z = starts(ModelKey(error=error), fitted=[ModelKey()])
    mean, covariance = posterior(X, ())
    assert (abs(z - mean) / np.sqrt(np.diag(covariance))).max() < 5
