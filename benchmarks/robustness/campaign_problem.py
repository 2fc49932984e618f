"""The campaign that is attacked: x = theta * action with a noise of .1."""

from __future__ import annotations

import torch
from sbi.utils import BoxUniform

from sbi_active import (
    Campaign,
    CampaignOptions,
    DiscreteActions,
    GaussianNoise,
    MixtureDensity,
    RefinementOptions,
    SimulatorModel,
)
from sbi_active.campaign.options import CampaignDetails

OPTIONS = CampaignOptions(
    num_simulations=300,
    num_samples=100,
    details=CampaignDetails(num_scored=200),
    density_estimator=MixtureDensity(hidden_features=(16,), num_iterations=30),
    refinement=RefinementOptions(num_histories=300, num_effective=25),
)


def campaign(method: str = "nsbi") -> Campaign:
    """Return a small campaign, theta uniform on [0, 1]."""
    return Campaign(
        SimulatorModel(lambda theta, action: theta * action, noise=GaussianNoise(0.1)),
        BoxUniform(torch.zeros(1), torch.ones(1)),
        DiscreteActions([0.5, 1.0, 3.0]),
        method=method,
        options=OPTIONS,
    )


def draws(c: Campaign) -> torch.Tensor:
    """Return draws of a belief that depend on it alone."""
    torch.manual_seed(7)
    return c.belief.sample(torch.Size([300]))
