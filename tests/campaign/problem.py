"""One parameter, a push and noise of a tenth: a campaign of a fraction of a second."""

import torch
from attrs import evolve
from sbi.utils import BoxUniform

from sbi_active.actions import DiscreteActions
from sbi_active.campaign import Campaign, CampaignOptions
from sbi_active.campaign.options import CampaignDetails
from sbi_active.inference import MixtureDensity, RefinementOptions
from sbi_active.inference.networks.ratio_network import RatioClassifier
from sbi_active.simulation import SimulatorModel

PRIOR = BoxUniform(torch.zeros(1), torch.ones(1))
ACTIONS = DiscreteActions([0.5, 1.0, 3.0])
MODEL = SimulatorModel(lambda theta, action: theta * action, noise=0.1)
REFINEMENT = RefinementOptions(num_histories=200, num_effective=25)
DETAILS = CampaignDetails(num_scored=200)
OPTIONS = CampaignOptions(
    num_simulations=300,
    num_samples=100,
    details=DETAILS,
    density_estimator=MixtureDensity(hidden_features=(16,), num_iterations=30),
    refinement=REFINEMENT,
    network="on demand",
)
RATIOS = RatioClassifier(hidden_features=(16,), num_iterations=50)


def noisy(theta, action):
    """The same model, which draws its noise itself."""
    return theta * action + 0.1 * torch.randn_like(theta)


def campaign(method="nsbi", simulator=MODEL, *, actions=ACTIONS, given=None, **changes):
    """Return a campaign with options changed, and further arguments given."""
    network = RATIOS if method == "seqbed" else OPTIONS.density_estimator
    options = evolve(OPTIONS, **{"density_estimator": network, **changes})
    given = {"method": method, "options": options, **(given or {})}
    return Campaign(simulator, PRIOR, actions, **given)


def draws(c, num=300):
    torch.manual_seed(5)
    return c.belief.sample((num,))
