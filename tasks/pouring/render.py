"""Pictures of a pour."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import image

from sbi_active.tasks.pouring.materials import cubes
from sbi_active.tasks.pouring.scene import DT, SCALE, World, pour

__all__ = ["render"]

SIZE = 320, 320  # pixels; by PyBullet's own software renderer, which needs no display
STEPS_PER_PICTURE = 12
SUFFIXES = (".gif", ".png")


def render(
    theta: Any,
    action: Any,
    path: str | Path,
    *,
    num_cubes: int = 100,
    seed: int = 0,
) -> Path:
    """Draw one pour: a GIF of it, or a PNG of the cubes at rest.

    Args:
        theta: Friction, rolling friction and restitution.
        action: Height, cm, place, cm, and rate, rad/s.
        path: Ends in .gif or .png.
        num_cubes: Number poured.
        seed: Of the pour.

    Returns:
        The path.

    Raises:
        ImportError: If PyBullet is not installed.
        ValueError: If the path ends otherwise.
    """
    path = Path(path)
    is_film = path.suffix.lower() == ".gif"
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(
            f"expected a path ending in {' or '.join(SUFFIXES)}; got {path}; rename it"
        )
    row = np.asarray(action, dtype=float).reshape(-1).tolist()
    pictures: list[np.ndarray] = []
    count = 0

    def watch(world: World, angle: float) -> None:
        nonlocal count
        count += 1
        if count % STEPS_PER_PICTURE == 0 and is_film:
            pictures.append(_picture(world, row[0] / 100))

    parameters = np.asarray(theta, dtype=float).reshape(-1).tolist()
    last = None if is_film else lambda world: pictures.append(_picture(world, 0.0))
    pour(cubes(num_cubes), parameters, row, seed=seed, watch=watch, at_rest=last)
    if is_film:
        _save_gif(pictures, path)
    else:
        image.imsave(path, pictures[-1])
    return path


def _picture(world: World, height: float) -> np.ndarray:
    """Return what a camera beside the pour sees, (height, width, 3), uint8."""
    p, own = world.engine, {"physicsClientId": world.client}
    reach = max(0.35, height + 0.1) * SCALE
    eye = [1.6 * reach, -0.5 * reach, 0.9 * reach]
    view = p.computeViewMatrix(eye, [0, 0, 0.35 * reach], [0, 0, 1], **own)
    projection = p.computeProjectionMatrixFOV(45, 1, 0.1, 10 * reach, **own)
    width, tall = SIZE
    rgba = p.getCameraImage(
        width, tall, view, projection, renderer=p.ER_TINY_RENDERER, **own
    )[2]
    return np.reshape(np.asarray(rgba, np.uint8), (tall, width, 4))[..., :3].copy()


def _save_gif(pictures: list[np.ndarray], path: Path) -> None:
    from PIL import Image  # comes with matplotlib

    first, *rest = [Image.fromarray(picture) for picture in pictures]
    first.save(
        path,
        save_all=True,
        append_images=rest,
        duration=math.ceil(1e3 * STEPS_PER_PICTURE * DT),
        loop=0,
    )
