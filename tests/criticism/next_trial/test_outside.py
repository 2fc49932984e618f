"""Actions beyond the permitted ones."""

import pytest

from sbi_active import DiscreteActions
from sbi_active.criticism.next_trial.candidates import extrapolated


@pytest.mark.parametrize(
    ("values", "farthest"),
    [
        ([0.5, 1.0, 3.0], 4.25),  # a speed has no other sign
        ([-0.5, -1.0, -3.0], -4.25),
        ([-1.0, 0.0, 1.0], 2.0),
    ],
)
def test_extrapolated_actions_keep_their_sign_where_there_is_one(values, farthest):
    actions = DiscreteActions(values)
    found = extrapolated(actions, actions.values, limit=16)[:, 0]
    assert not bool(actions.contains(found[:, None]).any())
    assert abs(farthest) == pytest.approx(float(found.abs().max()))
    if min(values) >= 0:
        assert float(found.min()) >= 0
    if max(values) <= 0:
        assert float(found.max()) <= 0
