"""Outcomes with many numbers, compared by a few summaries of them."""

import torch
from torch.distributions import MultivariateNormal

from sbi_active import (
    DiscreteActions,
    GaussianNoise,
    InformationGainDesigner,
    SimulatorModel,
)

NUM = 300
TIMES = torch.linspace(0.1, 1.0, NUM)
BELIEF = MultivariateNormal(torch.zeros(2), torch.eye(2))
BASIS = torch.stack([TIMES, torch.sin(8 * TIMES)])


def line(theta, action):
    return action * (theta @ BASIS)


def exact(action: float, sd: float) -> float:
    precision = torch.eye(2) + (action / sd) ** 2 * BASIS @ BASIS.T
    return 0.5 * float(torch.logdet(precision.double()))


def test_a_linear_model_tells_what_it_tells_in_closed_form():
    model = SimulatorModel(line, noise=GaussianNoise(2.0))
    actions = DiscreteActions([0.2, 1.0, 3.0])
    designer = InformationGainDesigner(actions, num_samples=1_000)
    design = designer.select(None, model, belief=BELIEF, seed=0)
    error = design.standard_error.nan_to_num(0.0)
    for k, action in enumerate((0.2, 1.0, 3.0)):
        gain = float(design.expected_information_gain[k])
        assert abs(gain - exact(action, 2.0)) < 4 * float(error[k]) + 0.03
    assert float(design.action) == 3.0
    assert any(
        "32 linear summaries stand for the 300 numbers" in n for n in design.notes
    )
