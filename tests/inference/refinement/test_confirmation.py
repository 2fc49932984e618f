"""Fresh simulations tell a belief that is right from one that is not."""

import numpy as np
import pytest
import torch
from torch.distributions import Independent, Normal

from sbi_active.inference.declared.settings import RefinementOptions
from sbi_active.inference.refinement.refining import by_replicates
from sbi_active.inference.refinement.regional import Regions, Task

PRIOR = Independent(Normal(torch.zeros(2), torch.ones(2)), 1)
ACTION = torch.tensor([[1.0], [2.0]])


def simulator(theta, action):
    mean = torch.stack([theta[:, 0] * action[:, 0], theta.sum(1)], 1)
    return mean + 0.1 * torch.randn_like(mean)


class Moved:
    """A belief that is off by some deviations."""

    def __init__(self, belief, by):
        self.belief = belief
        self.off = by * belief.variance.sqrt()

    def sample(self, shape):
        return self.belief.sample(shape) + self.off


@pytest.mark.parametrize("by", [0.0, 1.0])
def test_a_mean_that_the_regression_is_right_about_holds(by):
    x = torch.tensor([[0.5, 0.9], [1.0, 0.9]])
    settings = RefinementOptions(num_histories=1_000)
    task = Task(simulator, PRIOR, ACTION, x.double(), [], settings)
    torch.manual_seed(0)
    stages = Regions(task, None, 0)
    belief = stages.run()
    # Fresh simulations judge the regression, wherever the draws lie.
    found = by_replicates(stages, Moved(belief, by), np.random.default_rng(0))
    assert found.shift < 0.3
    assert found.holds
    assert found.num_simulations == 2 * 100


def test_a_regression_that_is_off_does_not():
    x = torch.tensor([[0.5, 0.9], [1.0, 0.9]])
    task = Task(
        simulator, PRIOR, ACTION, x.double(), [], RefinementOptions(num_histories=1_000)
    )
    torch.manual_seed(0)
    stages = Regions(task, None, 0)
    belief = stages.run()
    fresh = stages.histories.fresh

    def other(theta):
        x, lost = fresh(theta)
        return x + 0.1, lost

    stages.histories.fresh = other  # a deviation of the noise, in all numbers
    found = by_replicates(stages, belief, np.random.default_rng(0))
    assert not found.holds
    assert found.shift > 0.5
    noted = found.noted(belief.diagnostics)
    assert noted.trustworthy is False
    assert "its mean is off by" in noted.warnings[-1]
