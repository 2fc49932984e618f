import numpy as np
import pytest
import torch

from sbi_active.criticism import Trials
from sbi_active.criticism.data import Measurements


def test_ragged_trajectories_are_padded_and_masked():
    trials = Trials([1.0, 2.0], [np.arange(3.0), np.arange(5.0)])
    assert trials.x.shape == (2, 5)
    assert trials.mask.sum(1).tolist() == [3, 5]


def test_roles_split_and_keep_indices():
    trials = Trials([1.0, 2.0, 3.0], [1.0, 2.0, 3.0], role=["fit", "held out", "fit"])
    assert trials.fit.index.tolist() == [0.0, 2.0]
    assert trials.held_out.action.tolist() == [[2.0]]
    assert trials[1:].role == ["held out", "fit"]


def test_repeats_are_found_and_follow_a_selection():
    trials = Trials([1.0, 2.0, 1.0], [1.0, 2.0, 3.0])
    assert trials.repeat_of.tolist() == [-1, -1, 0]
    assert trials[[2, 0]].repeat_of.tolist() == [1, -1]


def test_names_stay_with_their_trials():
    trials = Trials(
        [1.0, 2.0, 3.0],
        [1.0, 2.0, 3.0],
        role=["fit", "held out", "fit"],
        names=["run 7", "run 9", 12],
    )
    assert trials.names == ("run 7", "run 9", "12")
    assert trials.fit.names == ("run 7", "12")
    assert trials.held_out.names == ("run 9",)
    assert trials[[2, 0]].select([1, 1]).names == ("run 7", "run 7")
    assert trials.called([0, 2]) == "trials run 7, 12"
    unnamed = Trials([1.0, 2.0], [1.0, 2.0], index=[4, 1_234_567.0])
    assert unnamed.names == ("4", "1234567")
    assert unnamed[1:].names == ("1234567",)


@pytest.mark.parametrize("names", ["ab", ["a"], ["a", "a"], ["a", " "]])
def test_names_are_one_each(names):
    with pytest.raises(ValueError, match="expected names of 2 trials, each another"):
        Trials([1.0, 2.0], [1.0, 2.0], names=names)


def test_measurements_skip_gaps_within_a_trajectory_alone():
    x = torch.tensor([[1.0, torch.nan, 3.0], [4.0, 5.0, 6.0]])
    trials = Trials([0.0, 1.0], x, sample_times=[0.0, 0.5, 2.0])
    m = Measurements.of(trials)
    assert m.x.tolist() == [1, 3, 4, 5, 6]
    assert m.gap.tolist() == [np.inf, 2.0, np.inf, 0.5, 1.5]
    assert m.trial.tolist() == [0, 0, 1, 1, 1]


def test_measurements_order_channels_before_times():
    x = torch.arange(12.0).reshape(2, 3, 2)  # trial, time, channel
    m = Measurements.of(Trials([0.0, 1.0], x, sample_times=[0.0, 1.0, 2.0]))
    assert m.x[:6].tolist() == [0, 2, 4, 1, 3, 5]
    assert m.x.tolist() == x.flatten()[m.position].tolist()
    assert np.isinf(m.gap).sum() == 4
    assert m.channel[:6].tolist() == [0, 0, 0, 1, 1, 1]


@pytest.mark.parametrize(
    ("arguments", "keywords", "message"),
    [
        (([1.0, 2.0], [1.0]), {}, "expected actions .* with as many rows"),
        (([1.0], [np.nan]), {}, "expected at least one valid trial"),
        (
            ([1.0, 2.0], [1.0, np.nan]),
            {"role": ["fit", "held out"]},
            r"expected measurements in the held-out trials; got NaN in trial 1;",
        ),
        (
            ([1.0, 2.0], np.ones((2, 3))),
            {"sample_times": [0.0, 1.0]},
            r"expected sample_times of shape \(3,\)",
        ),
    ],
)
def test_bad_trials(arguments, keywords, message):
    with pytest.raises(ValueError, match=message):
        Trials(*arguments, **keywords)


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
