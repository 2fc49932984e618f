"""Banks of pours, and what the likelihoods and overlaps make of them."""

import numpy as np
import pytest
import torch

pytest.importorskip("pybullet")
from benchmarks.pouring import bank  # noqa: E402
from benchmarks.pouring.likelihood import repeated  # noqa: E402
from benchmarks.pouring.material import bank as material_bank  # noqa: E402
from benchmarks.pouring.material.learned import Overlap, PointBelief  # noqa: E402
from sbi_active.tasks import get_task  # pyright: ignore  # noqa: E402


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
    task = get_task("pouring")
    assert len(bank.draw(task, "likely", 0)[1].unique(dim=0)) == len(bank.LIKELY)
    first, again = (bank.draw(task, "prior", 0)[0] for _ in range(2))
    assert torch.equal(first, again)
    assert len(first.unique(dim=0)) == bank.ROWS_A_FILE


def test_rows_of_the_bank_are_shared_out_by_place():
    task = get_task("pouring_real", cubes=8)
    parts = [material_bank.draw(task, "prior", k) for k in range(8)]
    action = torch.cat([part[1] for part in parts])
    share = [(action[:, 1] == p).float().mean().item() for p in material_bank.PLACES]
    assert share == pytest.approx([0.4, 0.5, 0.1], abs=0.08)
    known = {tuple(a) for a in task.actions.values.tolist()}
    assert {tuple(a) for a in action.tolist()} <= known
    again = material_bank.draw(task, "prior", 0)
    assert torch.equal(again[0], parts[0][0])
    assert not torch.equal(parts[1][0], parts[0][0])
    assert len(material_bank.draw(task, "compared", 0)[1].unique(dim=0)) == 1


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
