r"""Summaries of depth images: mesh coverage and principal components.

Both are functions of the raw outcome, images (n, 22500), so that one simulation has all
of them; which one is used is part of the action (delta).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from scipy.ndimage import uniform_filter
from torch import Tensor

from sbi_active.tasks.pouring.raster import NUM_PIXELS

__all__ = ["ImagePCA", "mesh_coverage"]

BLURS = (1, 3, 5)  # pixels
AREAS = (4, 3)  # along x and along y
COVERED = 0.5  # mm, of a blurred image, from which a pixel counts as covered
MOST_COMPONENTS = 300


def mesh_coverage(images: Tensor) -> Tensor:
    r"""Return how much of each of twelve areas is covered, at three blurs.

    A pixel is covered where the image, averaged over a square of b x b pixels, is
    higher than half a millimeter. Holes in a depth image, NaN, count as ground; they
    are left out of the average of their neighbors.

    Args:
        images: Heights in mm, shape (n, 22500).

    Returns:
        Shares in [0, 1], shape (n, 36), float32: blurs of 1, 3 and 5 pixels, each with
        4 x 3 areas, row by row along x.

    References:
        Kim & Matsubara, Applied Intelligence 2025, section 5.4.
    """
    x = _pictures(images)
    known = np.isfinite(x)
    holes = not known.all()
    x = np.where(known, x, 0) if holes else x
    n = len(x)
    found = np.empty((n, len(BLURS), *AREAS), np.float32)
    for k, blur in enumerate(BLURS):
        smooth = x
        if blur > 1:
            smooth = _blurred(x, blur)
            if holes:
                share = _blurred(known.astype(np.float32), blur, rim=1.0)
                smooth = smooth / np.maximum(share, 1e-6)
        covered = (smooth > COVERED) & known
        blocks = _blocks(covered)
        if not holes:
            found[:, k] = blocks.mean((2, 4))
        else:
            seen = _blocks(known).sum((2, 4))
            found[:, k] = blocks.sum((2, 4)) / np.maximum(seen, 1)
    return torch.from_numpy(found.reshape(n, -1))


class ImagePCA:
    r"""Principal components of a round's images, 22,500 numbers to at most 300.

    .. math::
        z = D^{-1/2} V^\top (x - \bar x)

    with the leading eigenvectors V of the images' covariance and their variances D, by
    the n x n matrix of inner products. A hole, NaN, is filled with the mean image's.

    Args:
        images: To fit, shape (n, 22500), n >= 2.
        num_components: At most; n - 1 where the images are fewer.

    Attributes:
        mean: Shape (22500,).
        components: Shape (22500, k), scaled.
        variances: Of each, mm^2, shape (k,).

    Raises:
        ValueError: If there are fewer than two images, or more components than 300.
    """

    def __init__(self, images: Tensor, num_components: int = MOST_COMPONENTS) -> None:
        if not 1 <= num_components <= MOST_COMPONENTS:
            raise ValueError(
                f"expected 1 to {MOST_COMPONENTS} components; got {num_components}; "
                "keep fewer"
            )
        x = _pictures(images).reshape(len(images), -1)
        if len(x) < 2:
            raise ValueError(
                f"expected two or more images to fit; got {len(x)}; simulate more"
            )
        with np.errstate(invalid="ignore"):
            mean = np.nanmean(x, 0, dtype=np.float64)
        self.mean = np.nan_to_num(mean).astype(np.float32)
        centered = np.nan_to_num(x - self.mean)  # a copy; 0 in holes
        values, vectors = np.linalg.eigh((centered @ centered.T).astype(np.float64))
        kept = min(num_components, len(x) - 1)
        values, vectors = values[::-1][:kept], vectors[:, ::-1][:, :kept]
        kept = max(1, int((values > 1e-6 * max(values[0], 1e-30)).sum()))
        values, vectors = values[:kept], vectors[:, :kept]
        self.variances = values / (len(x) - 1)
        axes = centered.T @ (vectors / np.sqrt(np.maximum(values, 1e-30)))
        scaled = axes / np.sqrt(np.maximum(self.variances, 1e-30))
        self.components = scaled.astype(np.float32)

    def __call__(self, images: Tensor) -> Tensor:
        """Return components, (n, 22500) -> (n, k), float32."""
        x = _pictures(images).reshape(len(images), -1)
        return torch.from_numpy(np.nan_to_num(x - self.mean) @ self.components)


def _blurred(x: np.ndarray, blur: int, *, rim: float = 0.0) -> np.ndarray:
    """Return means over squares of pixels, with a value beyond the rim."""
    size: Any = (0, blur, blur)
    return uniform_filter(x, size, mode="constant", cval=rim)


def _pictures(images: Tensor) -> np.ndarray:
    """Return images, shape (n, 150, 150)."""
    x = torch.as_tensor(images)
    if x.ndim != 2 or x.shape[1] != NUM_PIXELS**2:
        raise ValueError(
            f"expected depth images of {NUM_PIXELS} x {NUM_PIXELS} pixels, (n, "
            f"{NUM_PIXELS**2}); got {tuple(x.shape)}; resample them"
        )
    side = NUM_PIXELS
    return x.detach().cpu().numpy().astype(np.float32).reshape(-1, side, side)


def _blocks(mask: np.ndarray) -> np.ndarray:
    """Return pixels by area, (n, 150, 150) -> (n, 4, *, 3, *): rims go to the last."""
    rows, columns = (math.ceil(NUM_PIXELS / k) for k in AREAS)
    padded = np.zeros((len(mask), rows * AREAS[0], columns * AREAS[1]), mask.dtype)
    padded[:, :NUM_PIXELS, :NUM_PIXELS] = mask
    return padded.reshape(len(mask), AREAS[0], rows, AREAS[1], columns)
