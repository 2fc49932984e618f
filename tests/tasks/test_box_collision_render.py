import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence

from sbi_active.tasks import get_task  # noqa: F401  # pyright: ignore

pytest.importorskip("mujoco")
from sbi_active.tasks.box_collision import render  # noqa: E402

DRAW = """
import sys, torch
from sbi_active.tasks.box_collision import render
for path, speed in zip(sys.argv[1::2], map(float, sys.argv[2::2])):
    render(torch.full((3,), 0.5), speed, path)
"""


def draw(backend, *speeds):
    """Draw files, each with the speed of its push."""
    environment = {k: v for k, v in os.environ.items() if k != "DISPLAY"}
    environment |= {"MUJOCO_GL": backend, "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, "-c", DRAW, *(str(a) for pair in speeds for a in pair)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.mark.slow
def test_draws_a_film_and_the_picture_that_it_ends_with(tmp_path):
    film, last, slow = (tmp_path / name for name in ("a.gif", "a.png", "b.png"))
    done = draw("egl", (film, 4.0), (last, 4.0), (slow, 2.0))
    if "libegl1" in done.stderr:
        pytest.skip("no EGL here")
    assert done.returncode == 0, done.stderr
    with Image.open(film) as pictures:
        shown, seconds = [], 0.0
        for frame in ImageSequence.Iterator(pictures):
            shown.append(green(frame))
            # Pictures that repeat themselves are shown for longer instead.
            seconds += frame.info["duration"] / 1e3
    assert len(shown) > 8
    # One second, and a picture of its beginning.
    assert seconds == pytest.approx(1.04, abs=0.01)
    with Image.open(last) as picture, Image.open(slow) as other:
        assert picture.size == (480, 320)
        end, near = green(picture), green(other)
    start = middle(shown[0])
    assert abs(middle(shown[-1]) - middle(end)).max() < 1
    # The harder the push, the farther the cube goes.
    paths = [float(np.linalg.norm(middle(cube) - start)) for cube in (near, end)]
    assert 3 < paths[0] < 0.7 * paths[1]


def green(picture):
    """Return where the green cube is in view, bool, shape (height, width)."""
    red, green, blue = np.moveaxis(np.asarray(picture.convert("RGB"), float), -1, 0)
    return (green > 60) & (green > 2 * red) & (green > 2 * blue)


def middle(cube):
    """Return row and column of the middle of a cube, pixels."""
    assert cube.sum() > 100
    return np.argwhere(cube).mean(0)


def test_another_suffix_is_refused(tmp_path):
    with pytest.raises(ValueError, match="expected a path ending in .gif or .png"):
        render(torch.full((3,), 0.5), 4.0, tmp_path / "a.mp4")
