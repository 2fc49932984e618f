"""A campaign on parameters that no action tells apart."""

import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import (
    Campaign,
    CampaignOptions,
    DiscreteActions,
    GaussianNoise,
    SimulatorModel,
)

PRIOR = BoxUniform(torch.tensor([0.2, 0.2]), torch.tensor([1.0, 1.0]))
ACTIONS = DiscreteActions([1.0, 2.0])


def force(theta, action):
    return action * theta[:, :1] * theta[:, 1:]


MODEL = SimulatorModel(
    force, noise=GaussianNoise(0.01), parameter_names=["friction", "mass"]
)


@pytest.mark.parametrize("method", ["asbi", "nlhi"])
def test_the_belief_and_the_campaign_say_it(method):
    options = CampaignOptions(num_simulations=1_000, network="on demand")
    campaign = Campaign(MODEL, PRIOR, ACTIONS, method=method, options=options)
    campaign.attach([2.0], [2 * 0.5 * 0.7])
    assert repr(campaign) == f"Campaign({method}, 1 trials)"
    found = campaign.update().diagnostics.combinations  # pyright: ignore
    assert [c.text for c in found.known] == ["friction * mass"]
    assert [c.text for c in found.unknown] == ["friction / mass"]
    (known,) = found.known
    assert known.low - 0.02 < 0.35 < known.high + 0.02
    assert known.high - known.low < 0.1
    assert repr(campaign) == f"Campaign({method}, 1 trials; {found})"


def test_what_is_said_outlives_the_process(tmp_path):
    options = CampaignOptions(network="on demand")
    with Campaign(
        MODEL, PRIOR, ACTIONS, options=options, directory=tmp_path / "c"
    ) as c:
        c.attach([2.0], [2 * 0.5 * 0.7])
        said = c.update().diagnostics.combinations  # pyright: ignore
    loaded = Campaign.load(tmp_path / "c", simulator=MODEL)
    assert repr(loaded) == "Campaign(asbi, 1 trials)"  # nothing was read yet
    assert loaded.belief.diagnostics.combinations == said  # pyright: ignore
    assert repr(loaded).endswith(f"; {said})")
    loaded.close()
    assert "friction * mass" in str(Campaign.load(tmp_path / "c").belief.diagnostics)  # pyright: ignore


def test_the_report_says_it():
    options = CampaignOptions(network="on demand")
    campaign = Campaign(MODEL, PRIOR, ACTIONS, options=options)
    for action, x in ((1.0, 0.352), (2.0, 0.693), (1.0, 0.343), (2.0, 0.708)):
        campaign.attach([action], [x])
    report = campaign.criticize(evaluate=False)
    (known,) = report.combinations.known
    assert known.text == "friction * mass"
    assert known.low < 0.35 < known.high
    text = " ".join(str(report).split())
    assert "Of parameters together, known: friction * mass = " in text
    assert "Of parameters together" in report.to_markdown()
