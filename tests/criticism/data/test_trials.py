"""Trials as they come: arrays, names, roles, repeats, and units."""

import numpy as np
import pandas as pd
import pytest
import torch

from sbi_active.criticism import Trials
from sbi_active.criticism.data.columns import to_si


def test_roles_names_and_places_stay_with_their_trials():
    role, names = ["fit", "held out", "fit"], ["run 7", "run 9", 12]
    trials = Trials([1.0, 2.0, 3.0], [1.0, 2.0, 3.0], role=role, names=names)
    assert trials.names == ("run 7", "run 9", "12")
    assert trials.fit.index.tolist() == [0.0, 2.0]
    assert trials.fit.names == ("run 7", "12")
    assert trials.held_out.action.tolist() == [[2.0]]
    assert trials[1:].role == ["held out", "fit"]
    assert trials[[2, 0]].select([1, 1]).names == ("run 7", "run 7")
    assert trials.called([0, 2]) == "trials run 7, 12"
    unnamed = Trials([1.0, 2.0], [1.0, 2.0], index=[4, 1_234_567.0])
    assert unnamed.names == ("4", "1234567")
    assert unnamed[1:].names == ("1234567",)


SPEED, STOP = [1.0, 2.0], [[1.0, 2.0], [3.0, 4.0]]
NAN = float("nan")
ROLE = ["fit", "held out"]


#: What is wrong of two trials, and what is said of it.
BAD_TRIALS = [
    *(
        ({"names": names}, "expected names of 2 trials, each another")
        for names in ("ab", ["a"], ["a", "a"], ["a", " "])
    ),
    ({"x": [1.0]}, "expected finite actions .* with as many rows"),
    ({"x": [NAN, NAN]}, "expected at least one valid trial"),
    ({"x": [1.0, NAN], "role": ROLE}, "in the held-out trials; got NaN in trial 1"),
    ({"sample_times": [1.0]}, r"expected sample_times of shape \(2,\)"),
    ({"x": np.ones((2, 1)) + 1j}, "x of real numbers; got torch.complex128"),
    ({"index": [0.0, NAN]}, "expected finite numbers in index"),
    ({"repeat_of": [-1, 7]}, "expected repeat_of among the positions 0 to 1"),
    ({"mask": [[255, 1], [1, 0]]}, "expected a mask of True and False.*got .255"),
]


@pytest.mark.parametrize(("changes", "message"), BAD_TRIALS)
def test_bad_trials(changes, message):
    with pytest.raises(ValueError, match=message):
        Trials(**{"action": SPEED, "x": STOP} | changes)


def test_joined_trials_have_all_of_both_and_names_of_their_own():
    x = torch.arange(12.0).reshape(2, 6)
    parts = {"sample_times": torch.arange(12.0).reshape(2, 6), "names": [1, 2]}
    own = Trials([0.0, 1.0], x, start={"speed": [3.0, 4.0]}, **parts)
    times = torch.arange(6.0)
    start = {"speed": [5.0, 3.0]}
    new = Trials([2.0, 0.0], x, index=[2, 3], start=start, sample_times=times)
    both = own.joined(new)
    assert both.names == ("1", "2", "new 2", "3")
    assert both.index.tolist() == [0, 1, 2, 3]
    assert both.start["speed"].tolist() == [3, 4, 5, 3]
    assert both.sample_times[2:].tolist() == 2 * [times.tolist()]
    assert both.repeat_of.tolist() == [-1, -1, -1, 0]
    assert len(own) == 2


# What trials make of numbers as they come


@pytest.mark.parametrize("kind", [np.array, torch.tensor])
def test_what_was_given_may_change_afterwards(kind):
    numbers = {"action": SPEED, "x": STOP, "index": SPEED, "sample_times": SPEED}
    given = {k: torch.tensor(v).double() for k, v in numbers.items()}
    given = given if kind is torch.tensor else {k: v.numpy() for k, v in given.items()}
    trials = Trials(**given)
    before = {k: v.clone() for k, v in vars(trials).items() if torch.is_tensor(v)}
    for value in given.values():
        value[:] = 99.0
    for name, value in before.items():
        assert torch.equal(getattr(trials, name), value), name


def test_repeats_are_found_and_stay_together_where_the_first_is_left_out():
    role = ["held out", "fit", "fit", "fit"]
    trials = Trials([1.0, 1.0, 2.0, 1.0], [1.0, 2.0, 3.0, 4.0], role=role)
    assert trials.repeat_of.tolist() == [-1, 0, -1, 0]
    assert trials.fit.repeat_of.tolist() == [-1, -1, 0]
    assert trials[[3, 1]].repeat_of.tolist() == [-1, 0]
    told = Trials([1.0] * 4, [1.0, 2.0, 3.0, 4.0], repeat_of=[-1, 0, 1, 3])
    assert told.repeat_of.tolist() == [-1, 0, 0, -1]
    told = Trials([1.0] * 3, [1.0, 2.0, 3.0], repeat_of=[1, 0, -1])
    assert told.repeat_of.tolist() == [-1, 0, -1]


# Units of headers; see mujoco/test_recordings for logs of robots


UNITS = {"time": "ms", "action_v": "deg/s", "x_y": "mm", "input_u": "mNm"}
ROWS = [(0, 180, 5, 1), (20, 180, -2, 3)]


#: Units, their factor, and the unit in SI.
IN_SI = [
    ("mm/s^2", 1e-3, "m/s^2"),
    ("m/s²", 1, "m/s²"),
    ("1/mm", 1e3, "1/m"),
    ("°", np.pi / 180, "rad"),
    ("rpm", np.pi / 30, "rad/s"),
    ("mNm", 1e-3, "N m"),
    ("N m s/rad", 1, "N m s/rad"),
    ("mm s-1", 1e-3, "m s-1"),
    ("min", 60, "s"),
]


@pytest.mark.parametrize(("unit", "factor", "si"), IN_SI)
def test_units_become_si(unit, factor, si):
    assert to_si(unit) == (pytest.approx(factor), si)


@pytest.mark.parametrize("unit", ["px", "%", "°C", "g", "counts", "[m]"])
def test_what_is_no_scale_of_an_si_unit_is_not_guessed(unit):
    assert to_si(unit) is None


@pytest.mark.parametrize("where", ["header", "units", "folder"])
def test_numbers_of_a_table_become_si(where, tmp_path):
    names, units = [*UNITS], UNITS
    if where != "units":
        names, units = [f"{name} [{unit}]" for name, unit in UNITS.items()], None
    frame = pd.DataFrame(ROWS, columns=names)
    if where == "folder":
        frame.to_csv(tmp_path / "run.csv", index=False)
        trials = Trials.from_csv(tmp_path)
    else:
        trials = Trials.from_dataframe(frame.assign(trial=1), units=units)
    assert trials.sample_times.flatten().tolist() == [0, pytest.approx(0.02)]
    assert trials.action.item() == pytest.approx(np.pi)
    assert trials.x.flatten().tolist() == pytest.approx([0.005, -0.002])
    assert trials.inputs["u"].flatten().tolist() == pytest.approx([0.001, 0.003])
    assert trials.action_labels == ("v [rad/s]",)
    assert trials.channel_labels == ("y [m]",)


# Inputs over time, on one grid for all trials; see test_trial_tables for tables


X = torch.zeros(2, 3)
TIMES = torch.tensor([0.0, 0.5, 1.0])
FINE = torch.linspace(0, 1, 11)


def trials(inputs, input_times=FINE, **keywords):
    keywords = {"sample_times": TIMES, **keywords}
    return Trials(None, X, inputs=inputs, input_times=input_times, **keywords)


@pytest.mark.parametrize("action", [None, torch.ones(2)])
def test_without_actions_the_action_is_a_label(action):
    found = Trials(action, X, inputs={"u": torch.zeros(2, 11)}, input_times=FINE)
    is_label = found.action_is_label, found.select([1]).action_is_label
    assert is_label == (action is None,) * 2
    assert found.action[:, 0].tolist() == ([0, 1] if action is None else [1, 1])
    assert found.repeat_of.tolist() == [-1, 0]
    other = Trials(action, X, inputs={"u": torch.randn(2, 11)}, input_times=FINE)
    assert other.repeat_of.tolist() == [-1, -1]
    moved = trials({"u": torch.zeros(2, 11)}, start={"q": [1.0, 2.0]})
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
    found = trials({"u": torch.arange(11.0).expand(2, -1)}, np.stack([steps, late]))
    assert found.inputs["u"].tolist() == [[*range(11)]] * 2


def test_values_are_held_on_the_finest_grid_and_a_selection_is_not_resampled_again():
    found = trials(
        {"u": [[1.0, 2.0, 3.0], [5.0, 6.0, 7.0, 8.0, 9.0]]},
        [[0.0, 0.5, 1.0], [0.25, 0.5, 0.75, 1.0, 1.25]],
        role=["fit", "held out"],
        start={"q": [1.0, 3.0]},
    )
    assert found.input_times.tolist() == [0, 0.25, 0.5, 0.75, 1.0, 1.25]
    assert found.inputs["u"].tolist() == [[1, 1, 2, 2, 3, 3], [5, 5, 6, 7, 8, 9]]
    assert torch.equal(found.held_out.inputs["u"], found.inputs["u"][1:])
    assert torch.equal(found.held_out.input_times, found.input_times)
    assert found.held_out.start["q"].tolist() == [3.0]


LACKING, INF, BACK = torch.zeros(2, 11), torch.zeros(2, 11), FINE.clone()
LACKING[1, 4], INF[1, 10], BACK[3] = torch.nan, torch.inf, 0.1
FLAT = {"u": torch.zeros(2, 11)}


#: What is wrong of inputs, and what is said of it.
BAD_INPUTS = [
    ({"inputs": {"u": LACKING}}, "nan for input 'u' of trial 1, value 4; fill it in"),
    ({"inputs": {"u": INF}}, "inf for input 'u' of trial 1, value 10; fill it in"),
    ({"inputs": torch.zeros(2, 11)}, "expected inputs as {name: series}"),
    ({"inputs": FLAT, "start": torch.zeros(2, 1)}, "expected start states as {name: "),
    ({"inputs": FLAT, "input_times": BACK}, "got 0.1 after 0.2 for"),
    ({"inputs": None}, "expected actions, or inputs"),
    (
        {"inputs": FLAT, "input_times": FINE / 1000},
        "x of trial 0 measured within the time of its input 'u', 0 to 0.001",
    ),
]


@pytest.mark.parametrize(("arguments", "message"), BAD_INPUTS)
def test_bad_inputs(arguments, message):
    keywords = {"action": None, "input_times": FINE, "sample_times": TIMES, **arguments}
    with pytest.raises(ValueError, match=message):
        Trials(x=X, **keywords)
