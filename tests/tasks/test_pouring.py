"""Pours: the scene, its effects, its images, and what heaps share."""

import numpy as np
import pytest
import torch
from scipy.ndimage import maximum_filter

from sbi_active import simulate
from sbi_active.tasks import get_task
from sbi_active.tasks.pouring import ImagePCA
from sbi_active.tasks.pouring.materials import cubes
from sbi_active.tasks.pouring.raster import height_image, rotations
from sbi_active.tasks.pouring.scene import pour

pytest.importorskip("pybullet")

LOW = torch.tensor([20.0, 0.0, 5.0])  # the cheapest action that shows much


@pytest.fixture(scope="module")
def task():
    return get_task("pouring", cubes=12)


def test_cubes_come_to_rest_on_the_ground():
    heights = []

    def watch(world, angle):
        heights.append(world.poses()[:, 2].max())

    poses = pour(cubes(30), [0.5, 0.5, 0.3], [20.0, 0.0, 2.0], seed=1, watch=watch)
    assert poses.dtype == np.float32
    assert 0.1 < max(heights) < 0.4  # carried, not thrown
    z = poses[:, 2]
    # Of few solver iterations: single cubes sink by half their height.
    assert -0.002 < z.min() <= z.max() < 0.02
    assert 0.0018 < np.median(z) < 0.0028
    assert np.allclose(np.linalg.norm(poses[:, 3:], axis=1), 1, atol=1e-5)
    assert poses[:, 1].mean() > 0  # poured toward +y


def test_outcomes_are_bit_identical(task):
    theta = torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
    action, seeds = LOW.expand(5, 3), torch.arange(5)
    x = simulate(task.simulator, theta, action, seed=3).x
    again = get_task("pouring", cubes=12).simulator
    assert torch.equal(simulate(again, theta, action, seed=3, batch_size=2).x, x)
    order = torch.tensor([3, 0, 4, 2, 1])
    direct = task.simulator(theta, action, seeds)
    turned = task.simulator(theta[order], action[order], seeds[order])
    assert torch.equal(turned, direct[order])
    assert not torch.equal(simulate(again, theta, action, seed=4).x, x)


def test_every_parameter_changes_where_cubes_lie(task):
    base = torch.full((4, 3), 0.5)
    base[1:] += 0.4 * torch.eye(3)
    seeds = torch.zeros(4, dtype=torch.int64)
    poses = task.pours.poses(base, LOW.expand(4, 3), seeds)
    for changed in poses[1:]:
        assert np.abs(changed[:, :2] - poses[0, :, :2]).mean() > 0.005


def pours(task, **effects):
    theta = torch.full((2, 3), 0.5)
    return task.simulator(theta, LOW.expand(2, 3), torch.arange(2), **effects)


def test_every_effect_vanishes_at_its_null_and_not_elsewhere(task):
    x = pours(task)
    keywords = {"linear_damping": 0.8, "angular_damping": 0.8, "tilt": 3.0}
    keywords |= {"bucket_y": 0.01, "bucket_height": 0.01, "cohesion": 1.0, "lag": 0.1}
    assert set(keywords) == set(task.simulator.effect_names)
    assert torch.equal(pours(task, **dict.fromkeys(keywords, 0.0)), x)
    for name, value in keywords.items():
        column = torch.tensor([[0.0], [value]])
        changed = pours(task, **{name: column})
        assert torch.equal(changed[0], x[0]), name
        assert not torch.equal(changed[1], x[1]), name


HALF = np.array([0.002, 0.002, 0.0025])


def tumbled(num):
    """Poses of particles about the origin, every way up."""
    rng = np.random.default_rng(0)
    place = rng.uniform(-0.15, 0.15, (num, 2))
    height, turns = rng.uniform(0.002, 0.02, (num, 1)), rng.standard_normal((num, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    return np.concatenate([place, height, turns], 1)


def test_agrees_with_points_sampled_on_the_boxes():
    poses = tumbled(40)
    image = height_image(poses, np.tile(HALF, (40, 1)))
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (40, 400, 3)) * HALF
    world = np.einsum("nij,nkj->nki", rotations(poses[:, 3:]), points)
    world = (world + poses[:, None, :3]).reshape(-1, 3)
    cell = np.floor((world[:, :2] + 0.15) / 0.002).astype(int)
    seen = ((cell >= 0) & (cell < 150)).all(1)
    # Within a pixel, the surface of a tumbled box varies by its own height.
    near = maximum_filter(image, size=3)[tuple(cell[seen].T)]
    assert (near > 1e3 * world[seen, 2] - 2.5).mean() > 0.999


def images(num, seed=0):
    """Smooth images of three varying blobs."""
    weight = torch.rand(num, 3, generator=torch.Generator().manual_seed(seed))
    place = torch.linspace(-1, 1, 150)
    blobs = [torch.exp(-((place - c) ** 2) / 0.05) for c in (-0.5, 0.0, 0.5)]
    pairs = zip(blobs, blobs[::-1], strict=True)
    basis = torch.stack([torch.outer(a, b).flatten() for a, b in pairs])
    return weight @ basis, weight


def test_principal_components_tell_what_varies():
    x, weight = images(80)
    pca = ImagePCA(x)
    assert pca.components.shape == (22_500, 3)  # no more than there are
    z = pca(x)
    assert z.std(0).tolist() == pytest.approx([1.0] * 3, rel=0.01)
    assert z.T.cov().numpy() == pytest.approx(np.eye(3), abs=0.01)
    fresh, weight = images(40, seed=1)
    z = torch.cat([pca(fresh), torch.ones(40, 1)], 1)
    fit = z @ torch.linalg.lstsq(z, weight).solution
    assert float((fit - weight).abs().max()) < 1e-3
