"""The campaign in ``version_1/``, written by the first release that keeps campaigns.

    python -m tests.campaign.storage.version_1

It is read by all later ones; nothing here may change, nor is it to be written again.
"""

from pathlib import Path

import torch
from sbi.utils import BoxUniform

from sbi_active import (
    BoxActions,
    Campaign,
    CampaignOptions,
    MixtureDensity,
    RefinementOptions,
)

FOLDER = Path(__file__).parent / "version_1"


def simulator(theta, action):
    mean = theta[:, :1] * action + theta[:, 1:2] * torch.linspace(0, 1, 3)
    return mean + 0.1 * torch.randn(len(theta), 3)


def main():
    options = CampaignOptions(
        num_simulations=100,
        num_samples=50,
        num_scored=100,
        density_estimator=MixtureDensity(hidden_features=(8,), num_iterations=10),
        refinement=RefinementOptions(num_histories=200, num_particles=1_000),
    )
    prior = BoxUniform(torch.zeros(2), torch.ones(2))
    actions = BoxActions([0.5], [2.0], names=["speed"], units=["m/s"])
    with Campaign(
        *(simulator, prior, actions),
        method="nsbi",
        options=options,
        seed=1,
        directory=FOLDER,
    ) as campaign:
        campaign.attach([1.0], [0.31, 0.62, 0.9])
        campaign.attach([2.0], [62.0, 88.0, 121.0])
        campaign.correct(1, [0.62, 0.88, 1.21], reason="told in cm")
        campaign.attach([1.5], [0.4, float("nan"), 1.0])
        campaign.ask()
        mean = campaign.belief.mean
        print(campaign, mean)


if __name__ == "__main__":
    main()
