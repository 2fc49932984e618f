"""Banks of pours, and what the likelihoods and overlaps make of them."""

import numpy as np
import pytest

pytest.importorskip("pybullet")
from benchmarks.pouring.likelihood import repeated  # noqa: E402
from benchmarks.pouring.material.learned import Overlap, PointBelief  # noqa: E402


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


def test_the_volume_that_a_belief_shares_is_the_mean_over_its_draws():
    rng = np.random.default_rng(0)
    theta = rng.random((120, 8))
    volume = 5_000 + 3_000 * theta[:, 3] + 200 * rng.standard_normal(120)
    overlap = Overlap.fit(theta, volume)
    assert overlap.explained == pytest.approx(0.95, abs=0.03)
    assert overlap.mean(PointBelief.uniform()) == pytest.approx(6_500, abs=80)
    points = PointBelief.points()
    high = PointBelief(np.where(points[:, 3] > 0.8, 0.0, -1e3))
    assert overlap.mean(high) == pytest.approx(7_700, abs=100)
