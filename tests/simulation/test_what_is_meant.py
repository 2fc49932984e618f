"""What users write at first: taken where it is clear, refused early where it is not."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import (
    Campaign,
    GaussianNoise,
    InformationGainDesigner,
    RandomDesigner,
    SimulatorModel,
    simulate,
)
from sbi_active.criticism import Criticism, Trials
from sbi_active.simulation import SimulationError, check_simulator

PRIOR = BoxUniform(torch.zeros(1), torch.ones(1))
MODEL = SimulatorModel(lambda theta, action: theta * action, noise=0.02)
ROWS = torch.rand(4, 1), torch.rand(4, 1)
ACTIONS = [0.1, 1.0, 3.0]


def test_a_number_as_noise_is_a_gaussian_standard_deviation():
    assert isinstance(MODEL.noise, GaussianNoise)
    assert MODEL.noise.sd.item() == 0.02
    several = SimulatorModel(lambda theta, action: theta, noise=[0.1, 0.2])
    assert several.noise.sd.tolist() == [0.1, 0.2]
    with pytest.raises(ValueError, match="expected sd of real numbers"):
        SimulatorModel(lambda theta, action: theta, noise="small")


@pytest.mark.parametrize("make", [list, tuple, np.array, torch.tensor])
def test_a_list_of_actions_is_taken(make):
    actions = make(ACTIONS)
    campaign = Campaign(MODEL, PRIOR, actions)
    assert campaign.actions.values[:, 0].tolist() == pytest.approx(ACTIONS)
    assert InformationGainDesigner(actions).actions.action_dim == 1
    assert RandomDesigner(actions).select(seed=0).action.shape == (1,)
    assert check_simulator(MODEL, PRIOR, actions, num_rows=16).is_ready
    trials = Trials([1.0, 2.0, 3.0], [0.5, 1.0, 1.5])
    assert Criticism(MODEL, PRIOR, trials, actions=actions).actions.action_dim == 1


def test_a_function_of_one_row_says_so():
    def row(theta, action, rng):
        return theta * action + rng.normal()

    with pytest.raises(ValueError, match="pass batched=False"):
        SimulatorModel(row)
    with pytest.raises(ValueError, match="batched=False"):
        simulate(lambda theta, action: theta[0] * action[0], *ROWS, seed=0)
    with pytest.raises(SimulationError, match="batched=False"):
        simulate(lambda theta, action: {}[float(theta[0, 0])], *ROWS, seed=0)


def test_a_function_of_one_row_may_leave_out_the_generator():
    def row(theta, action, *, push=0.0):
        return theta * action + push

    model = SimulatorModel(row, batched=False, noise=0.1)
    exact = ROWS[0].double() * ROWS[1].double()
    assert torch.equal(model.mean(*ROWS), exact)
    assert torch.equal(model.mean(*ROWS, push=2.0), exact + 2)
    assert model.effect_names == ("push",)
    drag = SimulatorModel(lambda t, a, drag=0.0: t * a - drag, batched=False, noise=0.1)
    assert torch.equal(drag.mean(*ROWS, drag=1.0), exact - 1)
