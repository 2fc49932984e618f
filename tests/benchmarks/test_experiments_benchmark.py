"""The truth of a case runs the trials that a design asks for."""

import pytest
import torch

from benchmarks.experiments.run import Reality
from benchmarks.misfit.cases import draw_case


@pytest.mark.parametrize(("group", "number"), [("own", 330), ("letters", 333)])
def test_a_trial_at_the_drawn_action_is_the_one_that_was_drawn(group, number):
    case = draw_case(group, "E", number)
    truth, reality = case.truth, Reality.of(case, number)
    k = int(truth.fitted[-1])  # as if it were the next one
    reality.index = k
    x = reality.run(truth.action[k])
    assert torch.allclose(x, truth.measured(torch.tensor([k]))[0])
    assert reality.index == k + 1
    other = Reality(case, reality.actions, k).run(reality.actions.values[0])
    assert not torch.allclose(other, x)
    reality.index = len(truth.action) + 1  # a place that was not drawn
    assert reality.run(truth.action[0]).isfinite().all()
    assert len(case.truth.action) == len(truth.action)
