"""Noise that a learned likelihood does not follow, and beliefs that say so."""

import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import Campaign, CampaignOptions, DiscreteActions
from sbi_active.inference.emulation.refining import refine

PRIOR = BoxUniform(-2 * torch.ones(1), 2 * torch.ones(1))


def noisy(draw):
    return lambda theta, xi: theta * xi + 0.3 * draw(theta)


NOISES = {
    "normal": (torch.randn_like, True),
    "exponential": (
        lambda t: torch.distributions.Exponential(1.0).sample(t.shape),
        False,
    ),
    "two points": (lambda t: torch.randn_like(t).sign(), False),
    "varying": (lambda t: torch.exp(1.5 * t) * torch.randn_like(t), False),
}


@pytest.mark.parametrize("name", NOISES)
def test_few_simulations_tell_noise_that_is_not_normal(name):
    draw, holds = NOISES[name]
    options = CampaignOptions(max_simulations=500, planned_trials=3)
    actions = DiscreteActions([1.0, 2.0])
    campaign = Campaign(noisy(draw), PRIOR, actions, seed=0, options=options)
    torch.manual_seed(0)
    for _ in range(3):
        action = campaign.ask().action
        campaign.tell(noisy(draw)(torch.tensor([[0.5]]), action[None])[0])
    assert campaign.update().diagnostics.trustworthy is holds


@pytest.mark.parametrize(("slope", "holds"), [(0.0, True), (1.0, False)])
def test_a_scale_that_depends_on_the_parameters_is_a_doubt(slope, holds):
    """Its mean says nothing, so that the belief would be the prior."""

    def simulator(theta, xi):
        return 0.3 * theta + torch.exp(slope * theta) * torch.randn_like(theta)

    action, x = torch.ones(3, 1), torch.tensor([[0.1], [-0.1], [0.05]])
    torch.manual_seed(0)
    belief = refine(simulator, PRIOR, action, x, seed=0)
    found = belief.diagnostics
    assert found.assumptions["even_noise"].holds is holds
    assert found.trustworthy is holds
