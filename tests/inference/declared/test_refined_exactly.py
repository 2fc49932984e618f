"""Posteriors of a response that jumps, against integrals over a fine grid."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform
from torch import Tensor

from sbi_active.inference import RefinementOptions, refine
from sbi_active.inference.declared.simulated_belief import SimulatedBelief
from sbi_active.inference.engine.potential import (
    MeanTable,
    SimulatedLikelihood,
    declares_noise,
)
from sbi_active.seeding import forked_generators
from sbi_active.simulation import GaussianNoise, MissingRowsWarning, SimulatorModel
from sbi_active.simulation.workers.settings import IN_PROCESS

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


def half(theta: Tensor, action: Tensor) -> Tensor:
    """No measurement on the left."""
    x = jumping(theta, action)
    return torch.where(theta[:, :1] < 0.3, torch.nan, x)


@pytest.fixture
def model() -> SimulatorModel:
    return SimulatorModel(jumping, noise=GaussianNoise(SD))


def observe(model: SimulatorModel, seed: int) -> Tensor:
    with forked_generators(seed):
        return model(TRUTH.expand(len(ACTION), -1), ACTION).double()


def grid_evidence(model: SimulatorModel, action: Tensor, x: Tensor) -> float:
    """Midpoints of a grid of .004, on which the likelihood is smooth in each cell."""
    axis = (torch.arange(500).double() + 0.5) / 250 - 1
    theta = torch.cartesian_prod(axis, axis)
    log_likelihood = torch.zeros(len(theta)).double()
    for a, each in zip(action, x, strict=True):
        shape = len(theta), 1
        log_likelihood += model.log_prob(each.expand(shape), theta, a.expand(shape))
    return float(log_likelihood.logsumexp(0)) - math.log(len(theta))


def test_a_further_trial_goes_on_from_the_draws(model: SimulatorModel):
    x = observe(model, 2)
    first = refine(model, BOX, ACTION[:2], x[:2], settings=FEW, seed=0)
    second = refine(model, BOX, ACTION, x, past=first.histories, settings=FEW, seed=1)
    assert isinstance(second, SimulatedBelief)
    assert second.diagnostics.trustworthy, second.diagnostics.warnings
    assert isinstance(first, SimulatedBelief)
    kept = first.histories.pool.proposals
    every = second.histories.pool.proposals
    assert all(a[1] is b[1] for a, b in zip(kept, every, strict=False))
    assert len(every) >= len(kept) > 2
    exact = grid_evidence(model, ACTION, x)
    assert second.diagnostics.log_evidence == pytest.approx(exact, abs=0.5)

    # Draws of the second were simulated at the first's actions, and are free there.
    with forked_generators(0):
        theta = second.sample((500,))
    table = second.histories.table
    count = table.num_simulations
    assert bool(first.log_prob(theta).isfinite().all())
    second.log_prob(theta)
    assert table.num_simulations - count <= 2  # a draw of the prior's share

    corrected = x.clone()
    corrected[0] += 0.1
    assert not second.histories.leads_to(model, ACTION, corrected)


def test_a_smooth_density_costs_no_simulations(model: SimulatorModel):
    x = observe(model, 0)
    belief = refine(model, BOX, ACTION, x, settings=FEW, seed=0)
    assert isinstance(belief, SimulatedBelief)
    table = belief.histories.table
    count = table.num_simulations
    theta = BOX.sample((4_000,))
    smooth = belief.smooth_log_prob(theta).double()
    assert table.num_simulations == count
    # Normalized over the box, of area 4, to three standard errors of the mean.
    error = 3 * float(smooth.exp().std()) / 4_000**0.5
    assert float(smooth.exp().mean()) == pytest.approx(1 / 4, abs=error)
    loaded = pickle.loads(pickle.dumps(belief))
    assert torch.equal(loaded.log_prob(TRUTH), belief.log_prob(TRUTH))


def test_trials_without_a_measurement_count():
    model = SimulatorModel(half, noise=GaussianNoise(SD))
    x = torch.full((3, 1), torch.nan).double()
    likelihood = SimulatedLikelihood(MeanTable(model, IN_PROCESS), ACTION, x)
    theta = BOX.sample((100,))
    left = (theta[:, 0] < 0.3).numpy()
    assert (likelihood(theta) == np.where(left, 0.0, -np.inf)).all()
    x = observe(model, 0)  # the truth lies just on the right
    likelihood = SimulatedLikelihood(MeanTable(model, IN_PROCESS), ACTION, x)
    assert (np.isfinite(likelihood(theta)) == ~left).all()


@pytest.mark.slow
def test_a_fault_loses_its_draw_alone(model: SimulatorModel):
    def failing(theta: Tensor, action: Tensor) -> Tensor:
        if bool((theta[:, 1] > 0.9).any()):
            raise RuntimeError("diverged")
        return jumping(theta, action)

    faulty = SimulatorModel(failing, noise=GaussianNoise(SD))
    x = observe(model, 0)
    with pytest.warns(MissingRowsWarning):
        belief = refine(faulty, BOX, ACTION, x, settings=FEW, seed=0)
    assert isinstance(belief, SimulatedBelief)
    assert belief.diagnostics.num_missing > 0
    assert belief.diagnostics.log_evidence == pytest.approx(
        grid_evidence(model, ACTION, x), abs=0.5
    )


def test_only_declared_noise_beside_a_function_is_exact(model: SimulatorModel):
    theta, action = BOX.sample((8,)), ACTION[:1].expand(8, -1)
    assert declares_noise(model, theta, action)
    assert not declares_noise(model.__call__, theta, action)
    assert not declares_noise(SimulatorModel(jumping), theta, action)
    assert not declares_noise(
        SimulatorModel(jumping, noise=GaussianNoise(0.0)), theta, action
    )
    random = SimulatorModel(
        lambda t, a: t[:, :1] + torch.randn(len(t), 1), noise=GaussianNoise(SD)
    )
    assert not declares_noise(random, theta, action)


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
