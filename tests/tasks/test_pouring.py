import sys

import numpy as np
import pytest
import torch

from sbi_active import simulate
from sbi_active.tasks import get_task  # pyright: ignore

pytest.importorskip("pybullet")
from sbi_active.tasks.pouring.materials import cubes  # noqa: E402
from sbi_active.tasks.pouring.scene import pour  # noqa: E402

LOW = torch.tensor([20.0, 0.0, 5.0])  # the cheapest action that shows much


@pytest.fixture(scope="module")
def task():
    return get_task("pouring", cubes=12)


def rows(num, seed=0):
    theta = torch.rand(num, 3, generator=torch.Generator().manual_seed(seed))
    return theta, LOW.expand(num, 3)


def test_is_the_paper_s():
    task = get_task("pouring")
    assert task.cubes == 100
    assert task.parameter_names == ["friction", "rolling_friction", "restitution"]
    assert task.num_rounds == 6
    values = task.actions.values
    assert len(values) == 27
    assert [sorted(set(values[:, k].tolist())) for k in range(3)] == [
        [20.0, 80.0, 140.0],
        [-30.0, 0.0, 30.0],
        [0.5, 2.0, 5.0],
    ]
    assert task.actions.units == ["cm", "cm", "rad/s"]
    assert task.theta_true.tolist() == pytest.approx([0.2, 0.2, 0.8])
    other = get_task("pouring", target=2)
    assert other.theta_true.tolist() == pytest.approx([0.8, 0.8, 0.2])
    assert other.with_truth([0.1, 0.2, 0.3]).theta_true.tolist() == pytest.approx(
        [0.1, 0.2, 0.3]
    )
    assert task.pours.particles.masses == pytest.approx(np.full(100, 0.08))


def test_cubes_come_to_rest_on_the_ground():
    theta, action = [0.5, 0.5, 0.3], [20.0, 0.0, 2.0]
    heights = []
    poses = pour(
        cubes(30),
        theta,
        action,
        seed=1,
        watch=lambda world, angle: heights.append(world.poses()[:, 2].max()),
    )
    assert poses.dtype == np.float32
    assert 0.1 < max(heights) < 0.4  # carried, not thrown
    z = poses[:, 2]
    # Of few solver iterations: single cubes sink by half their height.
    assert -0.002 < z.min() <= z.max() < 0.02
    assert 0.0018 < np.median(z) < 0.0028
    assert np.allclose(np.linalg.norm(poses[:, 3:], axis=1), 1, atol=1e-5)
    assert poses[:, 1].mean() > 0  # poured toward +y


def test_outcomes_are_bit_identical(task):
    theta, action = rows(5)
    x = simulate(task.simulator, theta, action, seed=3).x
    again = get_task("pouring", cubes=12).simulator
    assert torch.equal(simulate(again, theta, action, seed=3, batch_size=2).x, x)
    order = torch.tensor([3, 0, 4, 2, 1])
    seeds = torch.arange(5)
    direct = task.simulator(theta, action, seeds)
    assert torch.equal(
        task.simulator(theta[order], action[order], seeds[order]), direct[order]
    )
    assert not torch.equal(simulate(again, theta, action, seed=4).x, x)


def test_every_parameter_changes_where_cubes_lie(task):
    base = torch.full((4, 3), 0.5)
    base[1:] += 0.4 * torch.eye(3)
    seeds = torch.zeros(4, dtype=torch.int64)
    poses = task.pours.poses(base, LOW.expand(4, 3), seeds)
    for changed in poses[1:]:
        assert np.abs(changed[:, :2] - poses[0, :, :2]).mean() > 0.005


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"target": 3}, "expected target among 1, 2; got 3"),
        ({"cubes": 0}, "expected 1 to 1000 particles; got 0"),
        ({"cubes": 1001}, "expected 1 to 1000 particles; got 1001"),
        ({"theta_true": (0.2, 0.2, 1.2)}, "expected theta_true of three numbers"),
        ({"theta_true": (0.2, float("nan"), 1)}, "expected theta_true of three"),
    ],
)
def test_bad_options(options, text):
    with pytest.raises(ValueError, match=text):
        get_task("pouring", **options)


@pytest.mark.parametrize(
    ("theta", "action", "text"),
    [
        ([0.5, 1.5, 0.5], [20, 0, 5], r"expected theta within \[0, 1\].*row 0"),
        ([0.5, float("nan"), 0.5], [20, 0, 5], "expected finite theta"),
        ([0.5, 0.5, 0.5], [5, 0, 5], "expected a height of 12 cm or more"),
        ([0.5, 0.5, 0.5], [20, 0, 0], "expected a height of 12 cm or more and a rate"),
        ([0.5, 0.5, 0.5], [float("nan"), 0, 1], "expected finite action"),
        ([0.5, 0.5, 0.5], [20, 0], "expected theta .n, 3. and action .n, 3."),
    ],
)
def test_bad_rows(task, theta, action, text):
    with pytest.raises(ValueError, match=text):
        task.simulator(torch.tensor([theta]), torch.tensor([action]).float())


def test_missing_pybullet_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(ImportError, match=r"pip install 'sbi-active\[pybullet\]'"):
        get_task("pouring")
