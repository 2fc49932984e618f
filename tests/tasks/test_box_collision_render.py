import os
import subprocess
import sys

import pytest
import torch
from PIL import Image

from sbi_active.tasks import get_task  # noqa: F401  # pyright: ignore

pytest.importorskip("mujoco")
from sbi_active.tasks.box_collision import render  # noqa: E402

DRAW = """
import sys, torch
from sbi_active.tasks.box_collision import render
render(torch.full((3,), 0.5), 4.0, sys.argv[1])
"""


def draw(path, backend):
    environment = {k: v for k, v in os.environ.items() if k != "DISPLAY"}
    environment |= {"MUJOCO_GL": backend, "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, "-c", DRAW, str(path)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.mark.slow
def test_without_a_display_it_names_the_package_to_install(tmp_path):
    done = draw(tmp_path / "a.png", "glfw")
    assert done.returncode == 1
    assert "expected an offscreen renderer" in done.stderr
    assert "apt-get install libegl1" in done.stderr


@pytest.mark.slow
def test_draws_a_film_and_a_picture(tmp_path):
    for name in ("a.gif", "a.png"):
        done = draw(tmp_path / name, "egl")
        if "libegl1" in done.stderr:
            pytest.skip("no EGL here")
        assert done.returncode == 0, done.stderr
        picture = Image.open(tmp_path / name)
        assert picture.size == (480, 320)
        # Pictures that repeat themselves are shown for longer instead.
        assert (getattr(picture, "n_frames", 1) > 8) == (name == "a.gif")
        # The green cube is in view.
        red, green, blue = (torch.tensor(list(c.getdata())) for c in split(picture))
        assert int(((green > 60) & (green > 2 * red) & (green > 2 * blue)).sum()) > 100


def split(picture):
    return picture.convert("RGB").split()


def test_another_suffix_is_refused(tmp_path):
    with pytest.raises(ValueError, match="expected a path ending in .gif or .png"):
        render(torch.full((3,), 0.5), 4.0, tmp_path / "a.mp4")
