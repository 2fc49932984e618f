"""The reference of whole campaigns: its box, its cells and what it learns."""

import numpy as np
import pytest
import torch

pytest.importorskip("pybullet")
from benchmarks.pouring import refined  # noqa: E402
from benchmarks.pouring.around import (  # noqa: E402
    box_around,
    campaigns,
)
from benchmarks.pouring.bank import Rows, draw  # noqa: E402
from benchmarks.pouring.grid_belief import GridBelief  # noqa: E402
from benchmarks.pouring.run import RESULTS  # noqa: E402
from benchmarks.rows import read  # noqa: E402
from sbi_active.tasks import get_task  # noqa: E402


def test_the_box_holds_the_beliefs_in_whole_cells():
    middles = GridBelief.middles().double()
    beliefs = [
        GridBelief(-200 * ((middles - torch.tensor(place)) ** 2).sum(1))
        for place in ([0.2, 0.5, 0.9], [0.3, 0.5, 0.9])
    ]
    box = box_around(beliefs)
    inside = box.holds(middles.numpy())
    for belief in beliefs:
        assert belief.log_density.softmax(0)[inside].sum() > 0.85
    np.testing.assert_allclose(box.low * 20, np.round(box.low * 20), atol=1e-9)
    assert box.high[2] == 1.0  # not beyond the prior
    assert inside.mean() == pytest.approx(box.volume)
    assert box.volume < 0.25


def test_campaigns_are_those_of_the_committed_rows():
    actions = get_task("pouring").actions.values
    rows = read(RESULTS / "target_1_asbi.csv")
    found = campaigns("1", actions, RESULTS)
    assert [own.seed for own in found] == sorted({int(row["seed"]) for row in rows})
    first = [r for r in rows if int(r["seed"]) == found[0].seed and r["round"] == "1"]
    chosen = actions[found[0].places[0]].tolist()
    assert chosen == [float(first[0][k]) for k in ("height", "position", "rate")]
    assert found[0].deltas[0] == int(first[0]["delta"])


def test_the_bank_gives_the_pours_of_an_action():
    task = get_task("pouring")
    drawn = draw(task, "prior", 0)
    rows = Rows(drawn.theta, drawn.action, np.zeros((50, 100, 7), np.float32), 0.0, {})
    rows.poses[..., 2] = -1  # nothing is above the ground
    action = drawn.action[3]
    found = refined.of_bank(rows, action, task)
    mine = (drawn.action == action).all(1)
    np.testing.assert_array_equal(found.theta, drawn.theta[mine].double())
    assert not found.images.any()
    both = refined.joined(found, found)
    assert len(both.theta) == len(both.images) == 2 * int(mine.sum())
