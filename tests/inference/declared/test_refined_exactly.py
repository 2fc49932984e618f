"""Posteriors of a response that jumps, against integrals over a fine grid."""

from __future__ import annotations

import math

import pytest
import torch
from sbi.utils import BoxUniform
from torch import Tensor

from sbi_active.inference import RefinementOptions, refine
from sbi_active.inference.declared.refining import SimulatedBelief
from sbi_active.seeding import forked_generators
from sbi_active.simulation import GaussianNoise, SimulatorModel

BOX = BoxUniform(-torch.ones(2), torch.ones(2))
SD, CELL = 0.02, 0.02
ACTION = torch.tensor([[0.3], [1.0], [0.6]])
TRUTH = torch.tensor([[0.31, -0.42]])
FEW = RefinementOptions(num_histories=1_200)


def jumping(theta: Tensor, action: Tensor) -> Tensor:
    """A plane, and in each cell a step of its own, of three noise deviations."""
    theta, action = theta.double(), action.double()
    cell = torch.floor(theta / CELL)
    phase = 12.9898 * cell[:, :1] + 78.233 * cell[:, 1:] + 37.719 * action
    step = (torch.sin(phase) * 43758.5453) % 1.0 - 0.5
    plane = theta[:, :1] * torch.cos(action) + theta[:, 1:] * torch.sin(action)
    return plane + 3 * SD * math.sqrt(12) * step


def smooth(theta: Tensor, action: Tensor) -> Tensor:
    return theta[:, :1] * torch.cos(action) + theta[:, 1:] * torch.sin(action)


@pytest.fixture
def model() -> SimulatorModel:
    return SimulatorModel(jumping, noise=GaussianNoise(SD))


def observe(model: SimulatorModel, seed: int) -> Tensor:
    with forked_generators(seed):
        return model(TRUTH.expand(len(ACTION), -1), ACTION).double()


def test_an_inflated_likelihood_is_not_gone_on_from():
    model = SimulatorModel(smooth, noise=GaussianNoise(SD))
    x = observe(model, 0)
    apart = torch.cat([x[:1], x[:1] + 100 * SD, x[1:]])
    action = ACTION[[0, 0, 1, 2]]
    first = refine(model, BOX, action[:3], apart[:3], settings=FEW, seed=0)
    assert isinstance(first, SimulatedBelief)
    assert first.diagnostics.noise_inflation > 10
    assert not len(first.histories.pool.u)
    past = first.histories
    second = refine(model, BOX, action, apart, past=past, settings=FEW, seed=1)
    assert second.diagnostics.noise_inflation > 10


def test_the_caller_s_arrays_are_copied(model: SimulatorModel):
    action, x = ACTION.clone(), observe(model, 0)
    belief = refine(model, BOX, action, x, settings=FEW, seed=0)
    theta = BOX.sample((20,))
    before = belief.log_prob(theta)
    action += 1
    x += 1
    assert torch.equal(belief.log_prob(theta), before)
