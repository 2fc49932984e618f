"""Proposals along ridges, and powers of a likelihood that leave draws effective."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from sbi_active.inference.engine import infer, search
from sbi_active.inference.engine.importance import _largest_power
from sbi_active.inference.engine.settings import Settings
from sbi_active.inference.sampling.weights import effective_sample_size
from tests.inference.engine.potentials import Given

SETTINGS = Settings(num_effective=100, num_draws=200, share_of_plenty=0)
X, SLOPE = 1.0, 0.4


def product(sd=1e-3):
    """One number that is the product of a parameter and a gain: a hyperbola."""
    return Given(lambda u: (X - u[:, :1] * np.exp(SLOPE * u[:, 1:])) / sd, 2, 1, sd=sd)


def evidence():
    """Return the log evidence of an error that is small beside the prior."""

    def density(gain):
        scale = np.exp(SLOPE * gain)
        return norm.pdf(gain) * norm.pdf(X / scale) / scale

    return np.log(quad(density, -8, 8)[0])


def spread():
    """Return the standard deviation of the gain."""
    gain = np.linspace(-8, 8, 4_001)
    scale = np.exp(SLOPE * gain)
    weight = norm.pdf(gain) * norm.pdf(X / scale) / scale
    mean = np.average(gain, weights=weight)
    return np.sqrt(np.average((gain - mean) ** 2, weights=weight))


def test_a_thin_ridge_has_the_right_evidence():
    own, rng = product(), np.random.default_rng(1)
    found = infer(own, rng, found=search(own, rng), settings=SETTINGS)
    assert found.method == "importance"
    assert found.effective_sample_size >= 100
    assert found.log_evidence == pytest.approx(evidence(), abs=4 * found.standard_error)
    assert own.num_rows < 12_000


@pytest.mark.parametrize("seed", range(2))
def test_a_ridge_is_followed_however_thin(seed):
    """At 1e-4 of the prior few normals along it left gaps, and particles half a nat."""
    own, rng = product(1e-4), np.random.default_rng(seed)
    found = infer(own, rng, found=search(own, rng))
    assert found.method == "importance"
    assert found.log_evidence == pytest.approx(evidence(), abs=0.1)
    gain = found.draws(4_000, rng)[:, 1]
    assert gain.std() == pytest.approx(spread(), rel=0.1)
    assert own.num_rows < 30_000


def test_the_largest_power_is_found_where_lower_ones_leave_fewer_draws():
    """A hundred draws at the peak, and those of the prior that outweigh them at .1."""
    at_peak = np.linspace(-0.5, 0.5, 100)
    at_peak[:4] += 3.0  # so that at power 1 few are effective
    log_new = np.concatenate([at_peak, -400.0 - 100.0 * np.arange(200)])
    log_rest = np.concatenate([np.zeros(100), np.full(200, 60.0)])
    for power in (0.1, 1.0):
        assert effective_sample_size(log_rest + power * log_new) < 60
    power = _largest_power(log_rest, log_new, 60.0)
    assert 0.4 < power < 1
    assert effective_sample_size(log_rest + power * log_new) == pytest.approx(60)
