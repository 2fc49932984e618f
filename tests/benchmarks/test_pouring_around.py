"""The reference of whole campaigns: its box, its cells and what it learns."""

import numpy as np
import pytest

pytest.importorskip("pybullet")
from benchmarks.pouring import refined  # noqa: E402
from benchmarks.pouring.around import (  # noqa: E402
    campaigns,
)
from benchmarks.pouring.bank import Rows, draw  # noqa: E402
from benchmarks.pouring.run import RESULTS  # noqa: E402
from benchmarks.rows import read  # noqa: E402
from sbi_active.tasks import get_task  # noqa: E402


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
