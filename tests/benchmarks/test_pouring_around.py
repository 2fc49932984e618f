"""The reference of whole campaigns: its box, its cells and what it learns."""

import numpy as np
import pytest
import torch

pytest.importorskip("pybullet")
from benchmarks.pouring import refined  # noqa: E402
from benchmarks.pouring.around import (  # noqa: E402
    NUM_CELLS,
    Box,
    Pours,
    box_around,
    campaigns,
    density,
    nearest,
    summarize,
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


def test_densities_are_per_volume_of_the_prior():
    box = Box(np.array([0.2, 0.0, 0.5]), np.array([0.4, 0.5, 1.0]))
    cells = box.cells()
    assert len(cells) == NUM_CELLS**3
    assert box.holds(cells).all()
    flat = np.zeros(len(cells))
    assert density(flat, 7, box.volume) == pytest.approx(-np.log(box.volume))
    assert nearest(cells, cells[11] + 1e-4) == 11


def test_campaigns_are_those_of_the_committed_rows():
    actions = get_task("pouring").actions.values
    rows = read(RESULTS / "target_1_asbi.csv")
    found = campaigns("1", actions, RESULTS)
    assert [own.seed for own in found] == sorted({int(row["seed"]) for row in rows})
    first = [r for r in rows if int(r["seed"]) == found[0].seed and r["round"] == "1"]
    chosen = actions[found[0].places[0]].tolist()
    assert chosen == [float(first[0][k]) for k in ("height", "position", "rate")]
    assert found[0].deltas[0] == int(first[0]["delta"])


def test_a_likelihood_by_both_summaries_finds_where_a_pile_lies():
    """Piles whose place and height follow two of three parameters."""
    rng = np.random.default_rng(0)
    theta = rng.random((120, 3))
    images = np.zeros((120, 150, 150), np.float32)
    for image, (a, b, _) in zip(images, theta, strict=True):
        place = int(30 + 80 * a)
        image[place : place + 12, 60:80] = 4 + 8 * b
    pours = Pours(theta, torch.from_numpy(images.reshape(120, -1)))
    fitted = pours.learn(np.arange(100))
    box = Box(np.zeros(3), np.ones(3))
    log_p = fitted.at(box.cells(), pours.images[100:])
    told = [
        density(row, nearest(box.cells(), one), box.volume)
        for row, one in zip(log_p, theta[100:], strict=True)
    ]
    assert np.mean(told) > 2.0


def test_the_table_has_the_gap_with_its_error():
    row = dict.fromkeys(
        ["power", "volume", "inside", "in_half", "in_most"], "0.5"
    ) | dict.fromkeys(["num_pours", "num_left_out"], "60")
    row |= {"target": "1", "seed": "3", "ours": "4.0", "reference": "4.25"}
    row |= {"left_out_ours": "3.0", "left_out_reference": "3.5", "left_out_se": "0.1"}
    text = summarize([row])
    assert "0.25" in text
    assert "0.50 +- 0.10" in text
    assert summarize([]) == "no campaigns yet"


def test_the_table_of_refined_beliefs_has_all_three():
    row = dict.fromkeys(refined.COLUMNS, "1.0") | {"target": "2", "gap": "0.4"}
    row |= {"left_out_ours": "3.9", "left_out_refined": "5.3", "num_left_out": "55"}
    text = refined.summarize([row, {**row, "seed": "2"}])
    assert "3.90 / 5.30 / 1.00" in text
    assert "0.40 +- 0.71" in text
    assert "110" in text


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
