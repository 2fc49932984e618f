"""A campaign of a fraction of a second, on disk or not."""

import torch
from sbi.utils import BoxUniform

from sbi_active.actions import BoxActions
from sbi_active.campaign import Campaign, CampaignOptions
from sbi_active.campaign.options import CampaignDetails
from sbi_active.inference import MixtureDensity
from sbi_active.simulation import SimulatorModel
from tests.campaign.problem import REFINEMENT

PRIOR = BoxUniform(torch.zeros(2), torch.ones(2))
ACTIONS = BoxActions([0.5], [2.0], names=["speed"], units=["m/s"])
OPTIONS = CampaignOptions(
    num_simulations=200,
    num_samples=100,
    details=CampaignDetails(num_scored=100),
    density_estimator=MixtureDensity(hidden_features=(8,), num_iterations=10),
    refinement=REFINEMENT,
)
TRUTH = torch.tensor([[0.3, 0.6]])


def mean(theta, action):
    return theta[:, :1] * action + theta[:, 1:2] * torch.linspace(0, 1, 4)


def drawn(theta, action):
    return mean(theta, action) + 0.1 * torch.randn(len(theta), 4)


MODEL = SimulatorModel(mean, noise=0.1, parameter_names=["a", "b"])


def outcome(action, index):
    """Return the same outcome for the same trial, whatever happened before."""
    generator = torch.Generator().manual_seed(index)
    noise = 0.1 * torch.randn(4, generator=generator)
    return mean(TRUTH, action[None])[0] + noise


def new(directory=None, simulator=MODEL, method="nsbi", **more):
    """Return a campaign; what is given besides takes the place of what is usual."""
    usual = {"prior": PRIOR, "actions": ACTIONS, "options": OPTIONS}
    given = {**usual, "method": method, "directory": directory, **more}
    return Campaign(simulator, **given)


def go_on(campaign, num_trials):
    """Run to a number of trials in all."""
    while len(campaign.history) < num_trials:
        trial = campaign.ask()
        campaign.tell(outcome(trial.action, trial.index))
    campaign.update()
    return campaign


def draws(campaign):
    torch.manual_seed(5)
    return campaign.belief.sample((300,))


def facts(campaign):
    return [
        (t.action.tolist(), t.x.tolist(), t.status, t.surprise, t.information_gained)
        for t in campaign.history
    ]
