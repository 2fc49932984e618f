"""A campaign on parameters that no action tells apart."""

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


def test_what_is_said_outlives_the_process(tmp_path):
    options = CampaignOptions(network="on demand")
    given = {"options": options, "directory": tmp_path / "c"}
    with Campaign(MODEL, PRIOR, ACTIONS, **given) as c:
        c.attach([2.0], [2 * 0.5 * 0.7])
        assert repr(c) == "Campaign(asbi, 1 trials)"
        said = c.update().diagnostics.combinations  # pyright: ignore
    assert [found.text for found in said.known] == ["friction * mass"]
    assert [found.text for found in said.unknown] == ["friction / mass"]
    (known,) = said.known
    assert known.low - 0.02 < 0.35 < known.high + 0.02
    assert known.high - known.low < 0.1
    loaded = Campaign.load(tmp_path / "c", simulator=MODEL)
    assert repr(loaded) == "Campaign(asbi, 1 trials)"  # nothing was read yet
    assert loaded.belief.diagnostics.combinations == said  # pyright: ignore
    assert repr(loaded) == f"Campaign(asbi, 1 trials; {said})"
