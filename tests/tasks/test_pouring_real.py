import numpy as np
import pytest
import torch

from sbi_active.tasks import get_task  # pyright: ignore

pytest.importorskip("pybullet")
from sbi_active.tasks.pouring import intersection_volume  # noqa: E402


@pytest.fixture(scope="module", params=["beads", "gravel"])
def task(request):
    return get_task("pouring_real", material=request.param, cubes=8)


def test_materials_are_not_the_model():
    beads = get_task("pouring_real", material="beads").real_pours.particles
    gravel = get_task("pouring_real", material="gravel").real_pours.particles
    model = get_task("pouring_real").pours.particles
    assert (beads.shape, gravel.shape, model.shape) == ("cylinder", "box", "box")
    assert np.ptp(model.half, axis=0).max() == 0
    assert 0.04 < np.log(beads.half[:, 0]).std() < 0.12
    assert 0.004 <= 2 * gravel.half.min() < 2 * gravel.half.max() <= 0.012
    # About as much material as the model has.
    volume = 8 * model.half.prod(1).sum()
    assert volume / 2 < 8 * gravel.half.prod(1).sum() < 1.2 * volume
    assert volume / 2 < 2 * np.pi * beads.half.prod(1).sum() < 1.2 * volume


def test_intersection_volume_is_what_two_heaps_share():
    real = torch.zeros(22_500)
    real[:10] = 4.0
    simulated = torch.zeros(2, 22_500)
    simulated[0, 5:15] = 6.0
    assert intersection_volume(real, simulated).tolist() == [20.0, 0.0]
    assert float(intersection_volume(real, real[None])) == 40.0
