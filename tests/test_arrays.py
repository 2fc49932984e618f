"""What users bring and get: numbers, keywords, and warnings at their line."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active.actions import DiscreteActions
from sbi_active.arrays import distance_from, measured, own_tensor
from sbi_active.campaign import Campaign
from sbi_active.criticism import Trials
from sbi_active.criticism.misfit.rule import Rule
from sbi_active.design import InformationGainDesigner
from sbi_active.mujoco import from_mjcf
from sbi_active.simulation import SimulatorModel

MASKED = np.ma.masked_array([1.0, 2.0], mask=[False, True])


#: One and two.
NUMBERS = [
    (1.0, np.float64(2.0)),
    [torch.tensor(1.0), 2.0],
    np.array([1, 2], dtype=">i2"),
    np.array([1, 2], dtype=object),
    torch.tensor([1.0, 2.0], requires_grad=True),
]


@pytest.mark.parametrize("given", NUMBERS)
def test_numbers_of_any_kind(given):
    assert measured(given).dtype == torch.float64
    assert measured(given).tolist() == [1.0, 2.0]
    assert not measured(given).requires_grad


@pytest.mark.parametrize("make", [torch.as_tensor, np.asarray, lambda rows: rows[:]])
@pytest.mark.parametrize("dtype", [None, torch.float32, torch.float64])
def test_a_copy_is_taken_of_views_too(make, dtype):
    given = make([3.0, 1.0, 2.0])
    own = own_tensor(given[1:], dtype)
    given[1] = 7.0
    assert own.tolist() == [1.0, 2.0]


def test_what_is_masked_or_none_is_nan():
    for given in (MASKED, [1.0, None], np.array([1.0, None], dtype=object)):
        assert measured(given).isnan().tolist() == [False, True]
        assert Trials([0.0, 1.0], given).mask[:, 0].tolist() == [True, False]


def test_what_is_no_real_number_is_refused():
    with pytest.raises(ValueError, match="expected speed of real numbers; got '1.5'"):
        measured("1.5", name="speed")
    with pytest.raises(ValueError, match="with rows of one length"):
        measured([[1.0], [2.0, 3.0]])


# Keywords that are mistyped, and what a notebook shows of an object


PRIOR = BoxUniform(torch.zeros(1), torch.ones(1))
ACTIONS = DiscreteActions([1.0, 2.0], names=["push"])
NONE = torch.zeros(0, 1), torch.zeros(0, 1)


def slide(theta, action):
    return theta * action


#: Calls, a keyword, and the one that was meant.
MISTYPED = [
    (lambda **k: Campaign(slide, PRIOR, ACTIONS, **k), "metod", "method"),
    (lambda **k: InformationGainDesigner(ACTIONS, **k), "estimators", "estimator"),
    (lambda **k: SimulatorModel(slide, **k), "noize", "noise"),
    (lambda **k: Trials([0.0], [0.0], **k), "sample_time", "sample_times"),
    (lambda **k: from_mjcf("", {}, **k), "sensor", "sensors"),
    (Rule, "chances", "chance"),
]


@pytest.mark.parametrize(("call", "wrong", "meant"), MISTYPED)
def test_a_mistyped_keyword_is_told_with_the_one_that_was_meant(call, wrong, meant):
    with pytest.raises(TypeError, match=f"got '{wrong}'; did you mean '{meant}'"):
        call(**{wrong: None})


# Warnings point at the user's line, from however deep


@pytest.mark.parametrize("read", [Trials.from_csv, lambda path: Trials.from_csv(path)])
def test_a_warning_points_at_who_read_it(read, tmp_path):
    file = tmp_path / "trials.csv"
    file.write_text("action_speed,x_place\n1,0.1\n2,\n")
    for path in (file, tmp_path):
        with pytest.warns(UserWarning, match="1 of 2 cells") as noted:
            read(path)
        assert [note.filename for note in noted] == [__file__]


def test_what_was_tried_is_at_a_distance_of_zero_far_from_zero_too():
    rows = 1e5 + torch.linspace(0, 1, 33, dtype=torch.float64)[:, None]
    distance = distance_from(rows[[4, 20]], rows)
    assert torch.nonzero(distance == 0)[:, 0].tolist() == [4, 20]
    assert float(distance.max()) == pytest.approx(12 / 32)
