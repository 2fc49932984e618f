import numpy as np
import pytest

from benchmarks.pouring.likelihood import (
    ImageLikelihood,
    components,
    cross_validated,
    grid,
    observed,
    thumbnails,
)
from benchmarks.pouring.reference import abc_log_prob


def pours(n, seed=0, noise=0.1):
    """Summaries of twelve numbers that see theta, and empty where friction is high."""
    rng = np.random.default_rng(seed)
    theta = rng.random((n, 3))
    weight = np.random.default_rng(9).normal(size=(3, 12))
    summary = theta @ weight + noise * rng.standard_normal((n, 12))
    return theta, summary, theta[:, 0] > 0.8


@pytest.fixture(scope="module")
def told():
    return cross_validated(*pours(100))


@pytest.mark.slow
def test_left_out_pours_are_told_as_well_as_the_exact_posterior_tells(told):
    _, log_p, mass = told
    filled = ~pours(100)[2]
    weight = np.random.default_rng(9).normal(size=(3, 12))
    # The entropy of the exact posterior, away from bounds; the grid costs some of it.
    volume = np.linalg.slogdet(weight @ weight.T / 0.1**2)[1]
    exact = 0.5 * volume - 1.5 * np.log(2 * np.pi * np.e)
    cell = 3 * np.log(10)
    assert min(exact, cell) - 1.5 < log_p[filled].mean() < cell
    assert 0.75 < (mass[filled] <= 0.9).mean() <= 1


@pytest.mark.slow
def test_an_image_without_cubes_tells_what_makes_it_empty(told):
    likelihood = told[0]
    cells = grid(6)
    log_p = likelihood.at(cells, None)
    high, low = cells[:, 0] > 0.8, cells[:, 0] < 0.6
    assert log_p[high].min() > log_p[low].max()


def test_outcomes_without_information_have_no_gain():
    rng = np.random.default_rng(1)
    theta = rng.random((60, 3))
    noise = rng.standard_normal((60, 8))
    likelihood, log_p, _ = cross_validated(theta, noise, np.zeros(60, dtype=bool))
    gain = likelihood.gain(rng.random((200, 3)), 100, rng)
    assert abs(log_p.mean()) < 0.3
    assert abs(gain.mean()) < 0.3


@pytest.mark.slow
def test_gain_is_that_of_the_left_out_pours(told):
    likelihood, log_p, _ = told
    theta = np.random.default_rng(2).random((800, 3))
    gain = likelihood.gain(theta, 400, np.random.default_rng(3)).mean()
    assert gain == pytest.approx(log_p.mean(), abs=1.0)


def test_pours_that_are_all_empty_leave_the_prior():
    theta, summary, _ = pours(60)
    fitted = ImageLikelihood.fit(theta, summary, np.ones(60, dtype=bool))
    assert np.ptp(fitted.at(grid(3), observed(fitted, summary[0], True))) == 0
    assert np.isfinite(fitted.at(grid(3), observed(fitted, summary[0], False))).all()


def test_nearest_pours_tell_less_than_the_exact_posterior_and_more_than_the_prior():
    theta, summary, _ = pours(220, noise=1.0)
    weight = np.random.default_rng(9).normal(size=(3, 12))
    volume = np.linalg.slogdet(weight @ weight.T + 12 * np.eye(3))[1]
    most = 0.5 * volume - 1.5 * np.log(2 * np.pi * np.e)  # with a normal prior
    log_p = abc_log_prob(theta, summary)
    assert 0.2 < log_p.mean() < most + 1.0


def test_thumbnails_and_components_keep_where_cubes_lie():
    images = np.zeros((6, 150, 150), np.float32)
    for k, image in enumerate(images):
        image[20 * k : 20 * k + 10, 40:50] = 4.0
    small = thumbnails(images.reshape(6, -1))
    assert small.shape == (6, 900)
    mean, axes = components(small, 36)
    assert axes.shape == (900, 5)  # six images span five dimensions
    back = mean + (small - mean) @ axes @ axes.T
    np.testing.assert_allclose(back, small, atol=1e-8)
