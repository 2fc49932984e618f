import pytest
import torch

pytest.importorskip("pybullet")
from sbi_active.tasks.pouring import intersection_volume  # noqa: E402


def test_intersection_volume_is_what_two_heaps_share():
    real = torch.zeros(22_500)
    real[:10] = 4.0
    simulated = torch.zeros(2, 22_500)
    simulated[0, 5:15] = 6.0
    assert intersection_volume(real, simulated).tolist() == [20.0, 0.0]
    assert float(intersection_volume(real, real[None])) == 40.0
