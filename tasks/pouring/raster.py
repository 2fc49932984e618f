r"""Depth images from poses, without a renderer.

Straight above each pixel near a particle, a ray is cut with the particle's own slabs:
with :math:`o` the ray's origin and :math:`d` its direction in the particle's frame, a
box of half sides :math:`h` is met at

.. math::
    t = \min_k \max\Bigl(\frac{-h_k - o_k}{d_k}, \frac{h_k - o_k}{d_k}\Bigr)

from above, if that is not below where the ray leaves it at the other side (the slab
method of Kay & Kajiya, SIGGRAPH 1986).
"""

from __future__ import annotations

import math

import numpy as np

__all__ = ["NUM_PIXELS", "PIXEL", "SIDE", "height_image", "rotations"]

SIDE = 0.30  # m, of the picture about the origin
NUM_PIXELS = 150
PIXEL = SIDE / NUM_PIXELS
PARALLEL = 1e-9  # of a direction, below which a ray runs along a slab


def rotations(quaternions: np.ndarray) -> np.ndarray:
    """Return rotation matrices, (n, 4) of (x, y, z, w) -> (n, 3, 3)."""
    x, y, z, w = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def height_image(poses: np.ndarray, half: np.ndarray, shape: str = "box") -> np.ndarray:
    """Return heights above the ground seen from straight above.

    Args:
        poses: Positions, m, and quaternions (x, y, z, w), shape (n, 7).
        half: Half sides, m, shape (n, 3).
        shape: "box", or "cylinder" of radius half[:, 0] and height 2 half[:, 2].

    Returns:
        mm, shape (150, 150), float32, first axis along x, second along y; 0 where
        there is only ground.
    """
    image = np.zeros(NUM_PIXELS**2, np.float32)
    poses = np.asarray(poses, np.float64)
    reach = np.sqrt((half**2).sum(1))
    seen = (np.abs(poses[:, :2]) < SIDE / 2 + reach[:, None]).all(1)
    poses, half = poses[seen], half[seen]
    if not len(poses):
        return image.reshape(NUM_PIXELS, NUM_PIXELS)
    place, frame = poses[:, :3], rotations(poses[:, 3:])
    window = math.ceil(float(reach.max()) / PIXEL)
    offset = np.arange(-window, window + 1)
    di, dj = (grid.ravel() for grid in np.meshgrid(offset, offset, indexing="ij"))
    nearest = np.floor((place[:, :2] + SIDE / 2) / PIXEL).astype(int)
    i, j = nearest[:, :1] + di, nearest[:, 1:] + dj  # (n, pixels)
    x = (i + 0.5) * PIXEL - SIDE / 2 - place[:, :1]
    y = (j + 0.5) * PIXEL - SIDE / 2 - place[:, 1:2]
    # In the particle's own axes: the rows of frame are the world's axes.
    origin = x[..., None] * frame[:, None, 0] + y[..., None] * frame[:, None, 1]
    along = frame[:, None, 2]
    along = np.where(np.abs(along) < PARALLEL, PARALLEL, along)
    enter, leave = _slabs(origin, along, half[:, None])
    if shape == "cylinder":
        bottom, top = _tube(origin, along, half[:, None, 0])
        caps = _slabs(origin[..., 2:], along[..., 2:], half[:, None, 2:])
        enter, leave = np.maximum(bottom, caps[0]), np.minimum(top, caps[1])
    inside = (i >= 0) & (i < NUM_PIXELS) & (j >= 0) & (j < NUM_PIXELS)
    met = (leave >= enter) & inside
    height = 1e3 * (place[:, 2:] + leave)
    np.maximum.at(image, (i * NUM_PIXELS + j)[met], height[met].astype(np.float32))
    return image.reshape(NUM_PIXELS, NUM_PIXELS)


def _slabs(
    origin: np.ndarray, along: np.ndarray, half: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays enter and leave a box, (n, pixels)."""
    below, above = (-half - origin) / along, (half - origin) / along
    return np.minimum(below, above).max(-1), np.maximum(below, above).min(-1)


def _tube(
    origin: np.ndarray, along: np.ndarray, radius: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays enter and leave an endless cylinder about the third axis."""
    a = (along[..., :2] ** 2).sum(-1)
    b = (origin[..., :2] * along[..., :2]).sum(-1)
    c = (origin[..., :2] ** 2).sum(-1) - radius**2
    square = b**2 - a * c
    root = np.sqrt(np.maximum(square, 0))
    missed = square < 0
    enter = np.where(missed, np.inf, (-b - root) / a)
    leave = np.where(missed, -np.inf, (-b + root) / a)
    return enter, leave
