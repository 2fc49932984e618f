"""Fresh simulations tell a belief that is right from one that is not."""

import pytest
import torch
from torch.distributions import Independent, Normal

from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.refinement.checks import compared_with_fresh
from sbi_active.inference.refinement.regional import Regions

PRIOR = Independent(Normal(torch.zeros(2), torch.ones(2)), 1)
ACTION = torch.tensor([[1.0], [2.0]])


def simulator(theta, action):
    mean = torch.stack([theta[:, 0] * action[:, 0], theta.sum(1)], 1)
    return mean + 0.1 * torch.randn_like(mean)


def compared(by=0.0, off=0.0):
    """Compare at draws that lie beside the belief, of outcomes that lie beside."""
    x = torch.tensor([[0.5, 0.9], [1.0, 0.9]])
    settings = RefinementOptions(num_histories=1_000)
    torch.manual_seed(0)
    stages = Regions(simulator, PRIOR, ACTION, x.double(), settings=settings, seed=0)
    belief = stages.run()
    theta = belief.sample((100,)) + by * belief.variance.sqrt()
    outcomes, lost = stages.histories.fresh(theta)
    assert not lost.any()
    return belief, compared_with_fresh(
        stages.stages[-1].surrogate,
        stages.coordinates.to_z(theta),
        outcomes + off,
        len(ACTION),
        stages.own,
    )


@pytest.mark.parametrize("by", [0.0, 1.0])
def test_a_mean_that_the_regression_is_right_about_holds(by):
    # Fresh simulations judge the regression, wherever the draws lie.
    belief, fresh = compared(by=by)
    assert fresh.shift < min(0.3, fresh.limit)
    assert belief.diagnostics.assumptions["confirmed"].holds
    assert fresh.tails[1] > 0.01 or by


def test_a_regression_that_is_off_does_not():
    _, fresh = compared(off=0.1)  # a deviation of the noise, in all numbers
    assert fresh.shift > max(0.5, fresh.limit)
