import math

import numpy as np
import pytest
import torch

from sbi_active.tasks import get_task  # noqa: F401  # pyright: ignore
from sbi_active.tasks.pouring import ImagePCA, mesh_coverage
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


def test_an_upright_box_covers_its_own_pixels():
    pose = np.array([[0.0, 0.02, 0.0025, 0, 0, 0, 1.0]])
    image = height_image(pose, HALF[None])
    assert image.shape == (150, 150)
    covered = np.argwhere(image > 0)
    assert len(covered) == 4  # 4 x 4 mm of 2 mm pixels
    assert covered[:, 0].tolist() == [74, 74, 75, 75]  # x first, then y
    assert covered[:, 1].min() == 84
    assert image.max() == pytest.approx(5.0, abs=1e-3)  # mm


def test_a_lying_cylinder_is_round_above():
    up = np.array([[0.0, 0.0, 0.01, 0, 0, 0, 1.0]])
    half = np.array([[0.01, 0.01, 0.01]])
    upright = height_image(up, half, "cylinder")
    assert upright[75, 75] == pytest.approx(20.0, abs=1e-3)
    assert (upright > 0).sum() * 4e-6 == pytest.approx(math.pi * 1e-4, rel=0.06)
    quarter = math.sqrt(0.5)
    lying = height_image(np.array([[0, 0, 0.01, quarter, 0, 0, quarter]]), half,
                         "cylinder")  # fmt: skip
    across = lying[:, 75]
    x = (np.arange(150) + 0.5) * 2e-3 - 0.15
    expected = np.where(np.abs(x) < 0.01, 10 + 1e3 * np.sqrt(
        np.maximum(1e-4 - x**2, 0)), 0)  # fmt: skip
    assert across == pytest.approx(expected, abs=1e-3)


def test_the_height_is_the_highest_of_what_is_met():
    poses = np.array([[0, 0, 0.0025, 0, 0, 0, 1.0], [0, 0, 0.0125, 0, 0, 0, 1.0]])
    image = height_image(poses, np.tile(HALF, (2, 1)))
    assert set(np.round(image[image > 0], 3)) == {15.0}


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


def test_agrees_with_the_engine_s_renderer():
    """TinyRenderer from 40 m above, where perspective is a third of a pixel."""
    p = pytest.importorskip("pybullet")
    large, poses, above = 5 * HALF, tumbled(25, seed=2), 40.0
    client = p.connect(p.DIRECT)
    own = {"physicsClientId": client}
    try:
        half = (10 * large).tolist()
        shape = p.createVisualShape(p.GEOM_BOX, halfExtents=half, **own)
        for pose in poses:
            place, turn = (10 * pose[:3]).tolist(), pose[3:].tolist()
            p.createMultiBody(0, -1, shape, place, turn, **own)
        near, far = above - 2, above + 2
        angle = 2 * math.degrees(math.atan(1.5 / above))
        projection = p.computeProjectionMatrixFOV(angle, 1, near, far)
        view = p.computeViewMatrix([0, 0, above], [0, 0, 0], [0, 1, 0])
        kind = p.ER_TINY_RENDERER
        picture = p.getCameraImage(150, 150, view, projection, renderer=kind, **own)
    finally:
        p.disconnect(client)
    depth, body = (np.reshape(part, (150, 150)).T[:, ::-1] for part in picture[3:])
    distance = far * near / (far - (far - near) * depth)
    rendered = np.where(body >= 0, 1e2 * (above - distance), 0.0)  # mm; lengths x 10
    mine = height_image(poses, np.tile(large, (25, 1)))
    both = (rendered > 0) & (mine > 0)
    assert both.sum() > 0.85 * ((rendered > 0) | (mine > 0)).sum()
    assert np.median(np.abs(rendered - mine)[both]) < 1.0
    assert abs((rendered > 0).sum() / (mine > 0).sum() - 1) < 0.03
    # A picture that is turned or mirrored is another one.
    assert both.sum() > 2 * ((rendered.T > 0) & (mine > 0)).sum()


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


def test_coverage_counts_areas():
    image = torch.zeros(150, 150)
    image[:38, :50] = 5.0  # the first of 4 x 3 areas
    found = mesh_coverage(image.reshape(1, -1))[0].reshape(3, 4, 3)
    assert found.shape == (3, 4, 3)
    assert found[0, 0, 0] == 1.0
    assert found[0].sum() == 1.0
    assert found[1:, 0, 0].min() > 0.95
    empty = mesh_coverage(torch.zeros(2, 22_500))
    assert empty.shape == (2, 36)
    assert float(empty.abs().max()) == 0.0


def test_a_blur_covers_more_of_what_is_scattered():
    image = torch.zeros(150, 150)
    image[4::8, 4::8] = 50.0
    by_blur = mesh_coverage(image.reshape(1, -1))[0].reshape(3, 12).mean(1)
    assert float(by_blur[1] / by_blur[0]) == pytest.approx(9, rel=0.1)
    assert float(by_blur[2] / by_blur[0]) == pytest.approx(25, rel=0.1)


def test_holes_are_masked():
    x, _ = images(30)
    x = 5 * x
    holes = x.clone()
    holes[:, ::97] = float("nan")
    before = holes.clone()
    assert float((mesh_coverage(holes) - mesh_coverage(x)).abs().max()) < 0.03
    pca = ImagePCA(x, 3)
    assert pca(holes).isfinite().all()
    assert float((pca(holes) - pca(x)).abs().max()) < 0.1
    assert ImagePCA(holes, 3)(holes).isfinite().all()
    assert torch.equal(holes.nan_to_num(-1), before.nan_to_num(-1))
    nothing = torch.full((2, 22_500), float("nan"))
    assert mesh_coverage(nothing).isfinite().all()
    assert pca(nothing).isfinite().all()


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


def test_images_that_are_all_alike_have_one_component_of_zero():
    pca = ImagePCA(torch.ones(5, 22_500))
    assert pca(torch.ones(2, 22_500)).abs().max() < 1e-6


@pytest.mark.parametrize("shape", [(2, 22_499), (22_500,), (2, 150, 150)])
def test_an_image_of_another_size_is_refused(shape):
    with pytest.raises(ValueError, match="expected depth images of 150 x 150 pixels"):
        mesh_coverage(torch.zeros(shape))
    with pytest.raises(ValueError, match="expected depth images of 150 x 150 pixels"):
        ImagePCA(torch.zeros(shape))


def test_bad_numbers_of_components():
    x, _ = images(4)
    with pytest.raises(ValueError, match="expected 1 to 300 components; got 301"):
        ImagePCA(x, 301)
    with pytest.raises(ValueError, match="expected two or more images to fit; got 1"):
        ImagePCA(x[:1])
