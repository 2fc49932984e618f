import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence

from sbi_active.tasks import get_task  # pyright: ignore

pytest.importorskip("pybullet")
from sbi_active.tasks.pouring import render  # noqa: E402

CONTEXT = None  # no effect here looks at it


@pytest.fixture(scope="module")
def task():
    return get_task("pouring", cubes=12)


def pours(task, **effects):
    theta = torch.full((2, 3), 0.5)
    action = torch.tensor([[20.0, 0.0, 5.0]]).expand(2, 3)
    return task.simulator(theta, action, torch.arange(2), **effects)


def test_every_effect_vanishes_at_its_null_and_not_elsewhere(task):
    x = pours(task)
    keywords = {
        "linear_damping": 0.8,
        "angular_damping": 0.8,
        "tilt": 3.0,
        "bucket_y": 0.01,
        "bucket_height": 0.01,
        "cohesion": 1.0,
        "lag": 0.1,
    }
    assert set(keywords) == set(task.simulator.effect_names)
    assert torch.equal(pours(task, **dict.fromkeys(keywords, 0.0)), x)
    for name, value in keywords.items():
        assert not torch.equal(pours(task, **{name: value}), x), name
        column = torch.tensor([[0.0], [value]])
        assert torch.equal(pours(task, **{name: column})[0], x[0]), name


def test_the_camera_shifts_and_stretches(task):
    effects = {effect.name: effect for effect in task.effects()}
    assert len(effects) == 9
    x = pours(task)
    action = torch.zeros(2, 3)
    gain, offset = effects["camera gain"], effects["camera offset"]
    assert torch.allclose(
        gain.apply(x, torch.full((2, 1), 0.1), action, CONTEXT), 1.1 * x
    )
    assert torch.equal(offset.apply(x, torch.zeros(2, 1), action, CONTEXT), x)
    moved = offset.apply(x, torch.full((2, 1), 0.006), action, CONTEXT)
    pictures, before = moved.reshape(2, 150, 150), x.reshape(2, 150, 150)
    assert torch.allclose(pictures[:, :, 3:], before[:, :, :-3], atol=1e-5)
    assert float(pictures[:, :, :3].abs().max()) == 0


def test_a_tilt_moves_cubes_downhill(task):
    theta = torch.tensor([[0.3, 0.1, 0.3]]).expand(4, 3)
    action, seeds = torch.tensor([[20.0, 0.0, 5.0]]).expand(4, 3), torch.arange(4)
    level = task.pours.poses(theta, action, seeds)[:, :, 1].mean()
    down = task.pours.poses(theta, action, seeds, tilt=6.0)[:, :, 1].mean()
    assert down > level + 0.005


def test_draws_a_film_and_a_picture(tmp_path):
    film = render([0.5] * 3, [20, 0, 5], tmp_path / "a.gif", num_cubes=4)
    with Image.open(film) as pictures:
        shown = [np.asarray(f.convert("L"), float) for f in ImageSequence.Iterator(
            pictures)]  # fmt: skip
    assert len(shown) > 15
    assert np.abs(shown[-1] - shown[0]).mean() > 1
    last = render([0.5] * 3, [20, 0, 5], tmp_path / "a.png", num_cubes=4)
    with Image.open(last) as picture:
        assert picture.size == (320, 320)
    with pytest.raises(ValueError, match="expected a path ending in .gif or .png"):
        render([0.5] * 3, [20, 0, 5], tmp_path / "a.mp4")
