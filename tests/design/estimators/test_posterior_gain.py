import math

import pytest
import torch

from sbi_active.design import PosteriorGain
from sbi_active.design.estimators.base import CandidateSimulations
from tests.linear_gaussian import PRIOR, ExactModel, information, simulator


def simulations(n=4_000):
    theta, action = torch.randn(n, 2), torch.tensor([[0.0], [1.0], [2.0]])
    x = torch.stack([simulator(theta, a.expand(n, 1)) for a in action])
    return CandidateSimulations(theta, action, x)


@pytest.mark.parametrize("spread", [1.0, 2.0])
def test_a_model_of_the_wrong_spread_loses_what_the_divergence_says(spread):
    """E U = I - KL(N(m, s) || N(m, (k s)^2)) in each of two dimensions."""
    rows = simulations()
    gain = PosteriorGain()(ExactModel(spread=spread), rows, PRIOR)
    loss = 2 * (math.log(spread) + 0.5 / spread**2 - 0.5)
    error = gain.std(1) / gain.shape[1] ** 0.5
    distance = (gain.mean(1) - (information(rows.action) - loss)).abs()
    assert (distance <= 4 * error + 1e-6).all()


def test_outcomes_without_a_density_are_not_left_out_of_the_mean():
    class Overflows(ExactModel):
        def log_posterior(self, theta, x, action):
            return torch.where(theta[:, 0] > 0, torch.nan, theta[:, 0])

    with pytest.raises(ValueError, match=r"densities of Overflows; got NaN at"):
        PosteriorGain()(Overflows(), simulations(n=64), PRIOR)
