"""What the picture of a design draws, for each kind of action."""

import matplotlib
import numpy as np
import pytest
import torch

from sbi_active import BoxActions
from sbi_active.design.design import Design

matplotlib.use("Agg")
import matplotlib.pyplot as plt


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")


def design(actions):
    rows = actions.sample((30,), seed=0)
    gain = rows.double().square().sum(1)
    error = [torch.full_like(gain, 0.05)] * 4
    made = {"bound": "lower", "index": 4, "num_simulations": 30}
    return Design(rows[4], rows, gain, *error, **made, labels=actions.entry_labels)


BOX = BoxActions([0.0, -1.0], [2.0, 1.0], names=["speed", "tilt"], units=["m/s", ""])


def test_two_entries_make_a_map_with_every_candidate_and_the_chosen_one():
    made = design(BOX)
    ax = made.plot()
    (marks,) = [c for c in ax.collections if len(c.get_offsets()) > 1]
    np.testing.assert_allclose(marks.get_offsets(), made.candidates)
    np.testing.assert_allclose(marks.get_array(), made.expected_information_gain)
    (chosen,) = [each for each in ax.lines if each.get_label() == "chosen"]
    np.testing.assert_allclose(chosen.get_xydata()[0], made.action)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("speed [m/s]", "tilt")
    assert [a.get_ylabel() for a in ax.figure.axes][1:] == ["EIG (lower bound) [nats]"]


def test_more_entries_make_candidates_in_order() -> None:
    made = design(BoxActions([0.0] * 3, [1.0] * 3))
    ax = made.plot()
    gain = made.expected_information_gain.sort(descending=True).values
    np.testing.assert_allclose(ax.lines[0].get_ydata(), gain)
    (chosen,) = [each for each in ax.lines if each.get_label() == "chosen"]
    place = int(chosen.get_xdata()[0])
    assert float(gain[place]) == float(made.expected_information_gain[made.index])
