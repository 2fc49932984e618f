"""Inputs over time: from arrays and from tables, on one grid for all trials."""

import numpy as np
import pandas as pd
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


# Inputs over time and start states from tables


LONG = "trial,time_ms,input_voltage[V],x_speed[rad/s],start_angle[rad]"
SAMPLES = ["a,0,1,0.1,.5", "a,100,2,0.2,.5", "b,0,3,0.3,.7", "b,100,4,0.4,.7"]
OTHER = ["a,0,1", "a,10,2", "a,20,3", "b,0,4", "b,10,5", "b,20,6", "c,0,0", "c,10,0"]
ROWS_OF_X = ["a,0,0.1", "a,0.02,0.2", "b,0.01,0.3"]


def write(name, rows, header):
    with open(name, "w") as file:
        file.write("\n".join([header, *rows]) + "\n")


def read(rows, header=LONG, **options):
    write("trials.csv", rows, header)
    return Trials.from_csv("trials.csv", **options)


def beside(inputs=OTHER, **options):
    write("inputs.csv", inputs, "trial,time_ms,input_u[V]")
    return read(ROWS_OF_X, "trial,time,x_y", inputs="inputs.csv", **options)


#: Table, what its inputs and x are, and the code of what is said.
TABLES = {
    "rows of inputs alone": (
        "trial,time_ms,input_u,x_y|a,0,1,0.1|a,10,2,|b,0,1,0.3|b,10,2,",
        *({"u": [[1, 2]] * 2}, [[0.1], [0.3]], ""),
    ),
    "rows of x alone hold the input": (
        "trial,time_ms,input_u,x_y|a,0,1,0.1|a,10,2,0.3|a,15,,0.2|a,20,4,0.5",
        *({"u": [[1, 2, 4]]}, [[0.1, 0.3, 0.2, 0.5]], "SA209"),
    ),
    "rows of each input alone, of a log of several topics": (
        "trial,time,input_u,input_v,x_y|a,0,1,,|a,0.1,,5,|a,0.5,,,7|a,1,2,,|a,1.1,,6,"
        "|a,1.5,,,8",
        *({"u": [[1, 2, 2]], "v": [[5, 5, 6]]}, [[7, 8]], "SA209"),
    ),
}


@pytest.mark.parametrize("case", TABLES)
def test_inputs_of_a_table(case, recwarn):
    table, inputs, x, code = TABLES[case]
    header, *rows = table.split("|")
    found = read(rows, header)
    assert {k: v.tolist() for k, v in found.inputs.items()} == inputs
    assert found.x.tolist() == x
    assert "".join(getattr(w.message, "code", "") for w in recwarn) == code


def test_inputs_stand_beside_x():
    trials = read(SAMPLES)
    assert trials.action_is_label
    assert trials.inputs["voltage"].tolist() == [[1, 2], [3, 4]]
    assert trials.input_labels == ("voltage [V]",)
    assert trials.input_times.tolist() == [0, 0.1]
    assert trials.start["angle"].tolist() == [0.5, 0.7]


def test_inputs_come_from_another_file_on_their_own_grid():
    trials = beside()
    assert trials.inputs["u"].tolist() == [[1, 2, 3], [4, 5, 6]]
    assert trials.sample_times[0].tolist() == [0, 0.02]
    frames = [pd.read_csv(name) for name in ("trials.csv", "inputs.csv")]
    again = Trials.from_dataframe(frames[0], inputs=frames[1])
    assert torch.equal(again.inputs["u"], trials.inputs["u"])
    lines = beside(["a,0,1", "a,10,2", "b,0,1", "b,5,2", "b,10,4"], input_hold="linear")
    assert lines.inputs["u"][0].tolist() == [1, 1.5, 2]


@pytest.mark.parametrize(
    ("rows", "column", "message"),
    [
        (
            ["a,0,1,5", "a,1,2,5"],
            "action_u",
            r"action_u, row 2 \(trial a\); got 2.0 after 1.0 .*input_",
        ),
        (
            ["a,0,1,5", "a,1,1,5", "a,2,1,5", "a,9,1,5", "a,10,1,5"],
            "input_u",
            "no value from 2 to 9 for input 'u' of trial a",
        ),
    ],
)
def test_a_table_with_inputs_that_is_not_understood(rows, column, message):
    with pytest.raises(ValueError, match=message):
        read(rows, f"trial,time,{column},x_y")
