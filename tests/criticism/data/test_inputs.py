"""Inputs over time, on one grid for all trials; see test_trial_tables for tables."""

import numpy as np
import pytest
import torch

from sbi_active.criticism import Trials

X = torch.zeros(2, 3)
TIMES = torch.tensor([0.0, 0.5, 1.0])
FINE = torch.linspace(0, 1, 11)


def trials(inputs, input_times=FINE, **keywords):
    keywords = {"sample_times": TIMES, **keywords}
    return Trials(None, X, inputs=inputs, input_times=input_times, **keywords)


@pytest.mark.parametrize("action", [None, torch.ones(2)])
def test_without_actions_the_action_is_a_label(action):
    found = Trials(action, X, inputs=torch.zeros(2, 11), input_times=FINE)
    assert (
        found.action_is_label == found.select([1]).action_is_label == (action is None)
    )
    assert found.action[:, 0].tolist() == ([0, 1] if action is None else [1, 1])
    assert found.repeat_of.tolist() == [-1, 0]
    other = Trials(action, X, inputs=torch.randn(2, 11), input_times=FINE)
    assert other.repeat_of.tolist() == [-1, -1]
    moved = trials(torch.zeros(2, 11), start=torch.tensor([1.0, 2.0]))
    assert moved.repeat_of.tolist() == [-1, -1]


def test_inputs_may_have_clocks_of_their_own():
    found = trials(
        {"u": [1.0, 2.0, 3.0], "v": torch.arange(5.0).expand(2, -1)},
        {"u": [0.0, 0.5, 1.0], "v": torch.linspace(0, 1, 5)},
    )
    assert found.input_times.tolist() == [0, 0.25, 0.5, 0.75, 1]
    assert found.inputs["u"].tolist() == [[1, 1, 2, 2, 3]] * 2
    assert found.inputs["v"].tolist() == [[0, 1, 2, 3, 4]] * 2
    with pytest.raises(ValueError, match="input_times of u; got those of v"):
        trials({"u": [1.0, 2.0, 3.0]}, {"v": [0.0, 0.5, 1.0]})


def test_jitter_does_not_move_values():
    """A value whose stamp is late by less than a thousandth step is on time."""
    steps = np.arange(11) * 0.1
    late = steps + 1e-6 * np.array([0, 1, -1, 1, 0, -1, 1, 0, 0, 1, 0])
    found = trials(torch.arange(11.0).expand(2, -1), np.stack([steps, late]))
    assert found.inputs["input"].tolist() == [[*range(11)]] * 2


def test_values_are_held_on_the_finest_grid_and_a_selection_is_not_resampled_again():
    found = trials(
        [[1.0, 2.0, 3.0], [5.0, 6.0, 7.0, 8.0, 9.0]],
        [[0.0, 0.5, 1.0], [0.25, 0.5, 0.75, 1.0, 1.25]],
        role=["fit", "held out"],
        start=torch.tensor([[1.0, 2.0], [3.0, 4.0]]),
    )
    assert found.input_times.tolist() == [0, 0.25, 0.5, 0.75, 1.0, 1.25]
    assert found.inputs["input"].tolist() == [[1, 1, 2, 2, 3, 3], [5, 5, 6, 7, 8, 9]]
    assert torch.equal(found.held_out.inputs["input"], found.inputs["input"][1:])
    assert torch.equal(found.held_out.input_times, found.input_times)
    assert found.held_out.start.tolist() == [[3.0, 4.0]]


NAN = torch.zeros(2, 11).index_put(
    (torch.tensor(1), torch.tensor(4)), torch.tensor(torch.nan)
)
BACK = FINE.clone().index_put((torch.tensor(3),), torch.tensor(0.1))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"inputs": NAN}, "NaN for input 'input' of trial 1, value 4; fill it in"),
        ({"inputs": torch.zeros(2, 11), "input_times": BACK}, "got 0.1 after 0.2 for"),
        ({"inputs": None}, "expected actions, or inputs"),
        (
            {"inputs": torch.zeros(2, 11), "input_times": FINE / 1000},
            "x of trial 0 measured within the time of its input 'input', 0 to 0.001",
        ),
    ],
)
def test_bad_inputs(arguments, message):
    keywords = {"action": None, "input_times": FINE, "sample_times": TIMES, **arguments}
    with pytest.raises(ValueError, match=message):
        Trials(x=X, **keywords)
