import numpy as np
import pytest
import torch

from sbi_active.tasks import get_task  # noqa: F401  # pyright: ignore
from sbi_active.tasks.pouring import ImagePCA
from sbi_active.tasks.pouring.raster import height_image, rotations

HALF = np.array([0.002, 0.002, 0.0025])


def tumbled(num, seed=0, spread=0.15):
    """Poses of particles about the origin, every way up."""
    rng = np.random.default_rng(seed)
    poses = np.empty((num, 7))
    poses[:, :2] = rng.uniform(-spread, spread, (num, 2))
    poses[:, 2] = rng.uniform(0.002, 0.02, num)
    turns = rng.standard_normal((num, 4))
    poses[:, 3:] = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    return poses


def test_agrees_with_points_sampled_on_the_boxes():
    poses = tumbled(40)
    image = height_image(poses, np.tile(HALF, (40, 1)))
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (40, 400, 3)) * HALF
    world = np.einsum("nij,nkj->nki", rotations(poses[:, 3:]), points)
    world = (world + poses[:, None, :3]).reshape(-1, 3)
    # Within a pixel, the surface of a tumbled box varies by its own height.
    cell = np.floor((world[:, :2] + 0.15) / 0.002).astype(int)
    seen = ((cell >= 0) & (cell < 150)).all(1)
    cell, z = cell[seen], 1e3 * world[seen, 2]
    near = np.stack(
        [
            image[np.clip(cell[:, 0] + i, 0, 149), np.clip(cell[:, 1] + j, 0, 149)]
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
        ]
    ).max(0)
    assert (near > z - 2.5).mean() > 0.999


def images(num, seed=0):
    """Smooth images of three varying blobs."""
    generator = torch.Generator().manual_seed(seed)
    place = torch.linspace(-1, 1, 150)
    weight = torch.rand(num, 3, generator=generator)
    blobs = [torch.exp(-((place - c) ** 2) / 0.05) for c in (-0.5, 0.0, 0.5)]
    basis = torch.stack(
        [torch.outer(a, b) for a, b in zip(blobs, blobs[::-1], strict=True)]
    )
    return (weight @ basis.reshape(3, -1)).float(), weight


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
