import numpy as np
import pytest
import torch

pytest.importorskip("pybullet")
from benchmarks.pouring.material.bank import PLACES, draw  # noqa: E402
from benchmarks.pouring.material.learned import (  # noqa: E402
    Overlap,
    PointBelief,
)
from sbi_active.tasks import get_task  # pyright: ignore  # noqa: E402


@pytest.fixture(scope="module")
def task():
    return get_task("pouring_real", cubes=8)


def test_rows_of_the_bank_are_shared_out_by_place(task):
    rows = [draw(task, "prior", k) for k in range(8)]
    action = torch.cat([r.action for r in rows])
    share = [(action[:, 1] == place).float().mean().item() for place in PLACES]
    assert share == pytest.approx([0.4, 0.5, 0.1], abs=0.08)
    known = {tuple(a) for a in task.actions.values.tolist()}
    assert {tuple(a) for a in action.tolist()} <= known
    assert torch.equal(draw(task, "prior", 0).theta, rows[0].theta)
    assert not torch.equal(rows[1].theta, rows[0].theta)
    assert len(draw(task, "compared", 0).action.unique(dim=0)) == 1


def test_the_volume_that_a_belief_shares_is_the_mean_over_its_draws():
    rng = np.random.default_rng(0)
    theta = rng.random((120, 8))
    volume = 5_000 + 3_000 * theta[:, 3] + 200 * rng.standard_normal(120)
    overlap = Overlap.fit(theta, volume)
    assert overlap.explained == pytest.approx(0.95, abs=0.03)
    assert overlap.mean(PointBelief.uniform()) == pytest.approx(6_500, abs=80)
    points = PointBelief.points()
    high = PointBelief(np.where(points[:, 3] > 0.8, 0.0, -1e3))
    assert overlap.mean(high) == pytest.approx(7_700, abs=100)
