"""Pictures of a box collision."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from matplotlib import image
from torch import Tensor

from sbi_active.tasks.box_collision.scene import (
    DT,
    FRAMES,
    STEPS_PER_FRAME,
    Scene,
    Surroundings,
    no_renderer,
)

__all__ = ["render"]

SIZE = 480, 320  # pixels
FRAMES_PER_PICTURE = 4
SUFFIXES = (".gif", ".png")


def render(
    theta: Tensor,
    action: Tensor | float,
    path: str | Path,
    *,
    offset: float = 0.0,
    surroundings: Surroundings | None = None,
) -> Path:
    """Draw one run: a GIF of it, or a PNG of the moment of observation.

    Args:
        theta: Shape (3,) or (1, 3).
        action: Speed of the pusher, m/s; a number or one row.
        path: Ends in .gif or .png.
        offset: Of the cube from the pusher's path, m.
        surroundings: What else there is.

    Returns:
        The path.

    Raises:
        ImportError: If MuJoCo is not installed.
        RuntimeError: If there is neither a display nor an offscreen renderer; the text
            names the package to install.
        ValueError: If the path ends otherwise.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(
            f"expected a path ending in {' or '.join(SUFFIXES)}; got {path}; rename it"
        )
    parameters = torch.as_tensor(theta).double().reshape(3).tolist()
    speed = float(torch.as_tensor(action).reshape(()))
    scene = Scene(offset=offset, early_exit=False)
    scene.prepare(parameters, speed, surroundings or Surroundings())
    pictures = _pictures(scene)
    if path.suffix.lower() == ".png":
        image.imsave(path, pictures[-1])
    else:
        _save_gif(pictures, path)
    return path


def _pictures(scene: Scene) -> list[np.ndarray]:
    """Return pictures of a prepared scene, each (height, width, 3), uint8."""
    mujoco = scene.mujoco
    width, height = SIZE
    try:
        renderer = mujoco.Renderer(scene.model, height, width)
    except Exception as error:
        # What fails depends on the driver: an import, a context or a missing symbol.
        raise RuntimeError(no_renderer(error)) from error
    camera = mujoco.MjvCamera()
    camera.lookat[:] = 0.25, 0.0, 0.0
    camera.distance, camera.azimuth, camera.elevation = 2.2, 120.0, -30.0
    pictures = []
    with renderer:
        for frame in range(0, FRAMES + 1, FRAMES_PER_PICTURE):
            if frame:
                steps = FRAMES_PER_PICTURE * STEPS_PER_FRAME
                mujoco.mj_step(scene.model, scene.data, steps)
            else:
                mujoco.mj_forward(scene.model, scene.data)
            renderer.update_scene(scene.data, camera)
            pictures.append(renderer.render())
    return pictures


def _save_gif(pictures: list[np.ndarray], path: Path) -> None:
    from PIL import Image  # comes with matplotlib

    seconds = FRAMES_PER_PICTURE * STEPS_PER_FRAME * DT
    first, *rest = [Image.fromarray(picture) for picture in pictures]
    first.save(
        path,
        save_all=True,
        append_images=rest,
        duration=round(1e3 * seconds),
        loop=0,
    )
