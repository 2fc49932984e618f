"""Modes and widths by Gauss-Newton steps, where both are known."""

import numpy as np

from sbi_active.inference.engine.search import search
from tests.inference.engine.potentials import Given


def test_where_nothing_fits_there_is_a_best_place():
    """Beside a sum of squares of 1e18 some nats are lost in the rounding."""
    own = Given(lambda u: 1e9 + np.stack([u[:, 0], 3 * u[:, 1]], 1), 2, 2)
    found = search(own, np.random.default_rng(0))
    assert len(found.modes) >= 1
    assert np.isfinite(found.guess.factors).all()
