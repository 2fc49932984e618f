"""What trials make of numbers as they come."""

import numpy as np
import pytest
import torch

from sbi_active.criticism import Trials

NAN = float("nan")
SPEED, STOP = [1.0, 2.0], [[1.0, 2.0], [3.0, 4.0]]


@pytest.mark.parametrize("kind", [np.array, torch.tensor])
def test_what_was_given_may_change_afterwards(kind):
    given = {
        "action": kind([1.0, 2.0]),
        "x": kind([[1.0, 2.0], [3.0, 4.0]]),
        "index": kind([0.0, 1.0]),
        "sample_times": kind([0.0, 1.0]),
    }
    given = {
        k: v.double() if torch.is_tensor(v) else v.astype(float)
        for k, v in given.items()
    }
    trials = Trials(**given)
    before = {k: v.clone() for k, v in vars(trials).items() if torch.is_tensor(v)}
    for value in given.values():
        value[:] = 99.0
    for name, value in before.items():
        assert torch.equal(getattr(trials, name), value), name


def test_what_a_masked_array_masks_is_not_measured():
    x = np.ma.masked_array(STOP, mask=[[0, 1], [0, 0]])
    assert Trials(SPEED, x).mask.tolist() == [[True, False], [True, True]]


@pytest.mark.parametrize(
    "x",
    [
        torch.ones(2, 1, requires_grad=True),
        torch.ones(2, 1, dtype=torch.bfloat16),
        np.array([[1], [1]], dtype=object),
    ],
)
def test_numbers_of_any_type_are_taken(x):
    assert Trials(SPEED, x).x.tolist() == [[1.0], [1.0]]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x": np.ones((2, 1)) + 1j}, "x of real numbers; got torch.complex128"),
        ({"index": [0.0, NAN]}, "expected finite places in index"),
        ({"repeat_of": [-1, 7]}, "expected repeat_of among the positions 0 to 1"),
        ({"repeat_of": [1, 0]}, "runs in a circle"),
        ({"mask": [[255, 1], [1, 0]]}, "expected a mask of True and False.*got 255"),
    ],
)
def test_what_is_no_measurement_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        Trials(**{"action": SPEED, "x": STOP} | changes)


def test_repeats_of_repeats_are_repeats_of_the_first():
    trials = Trials([1.0] * 4, [1.0, 2.0, 3.0, 4.0], repeat_of=[-1, 0, 1, 3])
    assert trials.repeat_of.tolist() == [-1, 0, 0, -1]


def test_repeats_stay_together_where_the_first_is_left_out():
    role = ["held out", "fit", "fit", "fit"]
    trials = Trials([1.0] * 4, [1.0, 2.0, 3.0, 4.0], role=role)
    assert trials.fit.repeat_of.tolist() == [-1, 0, 0]
    assert trials[[3, 1]].repeat_of.tolist() == [-1, 0]
