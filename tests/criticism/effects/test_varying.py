"""Parameters that depend on the action or the order of the trials."""

import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Trials, close_loop, varying_parameters

SPEED = torch.tensor([1.0, 2.5, 1.5, 3.0, 2.0, 0.75, 2.75, 1.25])
PRIOR = BoxUniform(torch.tensor([0.1, 0.0]), torch.tensor([1.0, 0.3]))


def stopping(theta, action):
    """Return the way to a stop (m) and its time (s), with a delay of the brake."""
    friction, delay = theta[:, :1], theta[:, 1:]
    way = action**2 / (2 * 9.81 * friction) + delay * action
    return torch.cat([way, action / (9.81 * friction) + delay], 1)


MODEL = SimulatorModel(
    stopping, noise=GaussianNoise(0.003), parameter_names=["friction", "delay"]
)


def trials_of(friction):
    torch.manual_seed(0)
    x = stopping(torch.stack([friction, torch.full((8,), 0.1)], 1), SPEED[:, None])
    return Trials(
        SPEED, x + 0.003 * torch.randn(x.shape), action_labels=["speed [m/s]"]
    )


@pytest.mark.parametrize(
    ("friction", "verdict"),
    [
        (0.5 + 0.1 * (SPEED - 1.875), "friction by speed"),
        (0.5 + 0.02 * (torch.arange(8) - 3.5), "friction by trial"),
        (torch.full((8,), 0.5), "none"),
    ],
)
def test_what_a_parameter_depends_on_is_named(friction, verdict):
    trials = trials_of(friction)
    effects = varying_parameters(MODEL, PRIOR, trials)
    report = close_loop(
        MODEL, PRIOR, trials, effects=effects, evaluate=False, plan=False
    )
    assert report.verdict == verdict


def test_parameters_stay_within_their_prior():
    trials = trials_of(torch.full((8,), 0.5))
    effect = varying_parameters(MODEL, PRIOR, trials)[0]
    theta = torch.tensor([[0.9, 0.1], [0.2, 0.1], [0.5, 0.1]])
    action, phi = torch.tensor([[3.0], [0.75], [1.875]]), torch.full((3, 1), 9.0)
    moved = effect.apply(theta.clone(), phi, action, None)
    expected = torch.tensor([[1.0, 0.1], [0.1, 0.1], [0.5, 0.1]])
    torch.testing.assert_close(moved, expected)
    kept = effect.apply(theta.clone(), 0 * phi, action, None)
    assert torch.equal(kept, theta)


def test_labels_constants_and_an_unknown_order_vary_nothing():
    x = torch.zeros(4, 2)
    constant = Trials(torch.ones(4), x, order="unknown")
    assert varying_parameters(MODEL, PRIOR, constant) == []
    two = Trials(torch.tensor([[1.0, 2.0], [2.0, 2.0]]), x[:2])
    names = [e.name for e in varying_parameters(MODEL, PRIOR, two)]
    assert names == [
        *("friction by action 1", "friction by trial"),
        *("delay by action 1", "delay by trial"),
    ]
