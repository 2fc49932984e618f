import numpy as np
import pytest
import torch

from benchmarks.pouring.bank import LIKELY, ROWS_A_FILE, draw
from benchmarks.pouring.likelihood import (
    ImageLikelihood,
    components,
    observed,
    repeated,
    thumbnails,
)
from benchmarks.pouring.power import cross_validated, grid
from sbi_active.tasks import get_task  # pyright: ignore


def pours(n, seed=0, noise=0.1):
    """Summaries of twelve numbers that see theta, and empty where friction is high."""
    rng = np.random.default_rng(seed)
    theta = rng.random((n, 3))
    weight = np.random.default_rng(9).normal(size=(3, 12))
    summary = theta @ weight + noise * rng.standard_normal((n, 12))
    return theta, summary, theta[:, 0] > 0.8


def test_outcomes_without_information_have_no_gain():
    rng = np.random.default_rng(1)
    theta = rng.random((60, 3))
    noise = rng.standard_normal((60, 8))
    likelihood = cross_validated(theta, noise, np.zeros(60, dtype=bool))
    gain = likelihood.gain(rng.random((200, 3)), 100, rng)
    assert abs(gain.mean()) < 0.3


def test_pours_that_are_all_empty_leave_the_prior():
    theta, summary, _ = pours(60)
    fitted = ImageLikelihood.fit(theta, summary, np.ones(60, dtype=bool))
    assert np.ptp(fitted.at(grid(3), observed(fitted, summary[0], True))) == 0
    assert np.isfinite(fitted.at(grid(3), observed(fitted, summary[0], False))).all()


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


def test_a_repeat_tells_less_than_a_first_pour():
    mean, error, noise = np.array([[0.0]]), np.array([[0.04]]), np.array([[1.0]])
    first = repeated(mean, error, noise, [], 0.2)
    assert first[0] == 0
    assert first[1] == pytest.approx(np.sqrt(1.04))
    # The error that repeats share: exact for normal variables.
    earlier = [np.array([0.5]), np.array([1.5])]
    common, alone = 0.24, 0.8
    cover = common + alone * np.eye(3)
    known = cover[2, :2] @ np.linalg.inv(cover[:2, :2])
    moved = repeated(mean, error, noise, earlier, 0.2)
    assert moved[0] == pytest.approx(known @ [0.5, 1.5])
    assert moved[1] ** 2 == pytest.approx(cover[2, 2] - known @ cover[:2, 2])
    # Without anything in common, earlier pours of the action change nothing.
    same = repeated(mean, 0 * error, noise, earlier, 0.0)
    assert same[0] == 0
    assert same[1] == 1


def test_a_bank_is_drawn_by_the_number_of_its_file():
    pytest.importorskip("pybullet")
    task = get_task("pouring")
    assert len(draw(task, "likely", 0).action.unique(dim=0)) == len(LIKELY)
    first, again = draw(task, "prior", 0).theta, draw(task, "prior", 0).theta
    assert torch.equal(first, again)
    assert len(first.unique(dim=0)) == ROWS_A_FILE
