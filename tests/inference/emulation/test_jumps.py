"""Jumps that lie between few rows: a belief is right, or says that it may not be."""

import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import (
    BoxActions,
    Campaign,
    CampaignOptions,
    GaussianNoise,
    SimulatorModel,
)

EDGE = -0.4


def belief_of(response, seed):
    """Return the belief of two trials, each a slope and a response beside it."""

    def fn(theta, xi):
        return theta[:, :1] * xi + 3 * response(theta[:, 1:] - EDGE)

    simulator = SimulatorModel(fn, noise=GaussianNoise(0.1))
    prior = BoxUniform(-torch.ones(2), torch.ones(2))
    options = CampaignOptions(max_simulations=300, planned_trials=2)
    campaign = Campaign(
        simulator, prior, BoxActions([0.5], [1.5]), options=options, seed=seed
    )
    truth = torch.tensor([[0.3, EDGE + 0.05]])
    for xi in (0.7, 1.3):
        action = torch.tensor([[xi]])
        campaign.attach(action[0], fn(truth, action)[0])
    return campaign.update()


@pytest.mark.parametrize("seed", [0, 1])
def test_a_jump_is_followed_or_said_to_be_missed(seed):
    """Beyond the jump the second parameter changes nothing: it may be anywhere."""
    belief = belief_of(lambda off: (off > 0).float(), seed)
    middle, sd = 0.5 * (1 + EDGE), (1 - EDGE) / 12**0.5
    is_right = abs(float(belief.mean[1]) - middle) < 0.3 * sd
    assert is_right or not belief.diagnostics.trustworthy


def test_a_steep_response_that_rows_resolve_is_trusted():
    belief = belief_of(lambda off: torch.sigmoid(off / 0.1), 0)
    assert belief.diagnostics.trustworthy
