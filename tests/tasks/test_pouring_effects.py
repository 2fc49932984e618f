import pytest
import torch

from sbi_active.tasks import get_task  # pyright: ignore

pytest.importorskip("pybullet")


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
