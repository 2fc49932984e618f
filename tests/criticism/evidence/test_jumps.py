"""A simulator that jumps: what its jumps count as, and evidence beside them."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import AugmentedSimulator, Trials
from sbi_active.criticism.rivals.rival_set import RivalSet
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from tests.effects import BIAS, effect, normal

NOISE, JUMP = 0.1, 0.2
BOX = BoxUniform(-2 * torch.ones(2), 2 * torch.ones(2))
PLACES = torch.tensor([-2.0, -1.5, -1.0, -0.5, 0.5, 1.0, 1.5, 2.0])[:, None]
DRIFT = effect(
    "drift",
    hook="action",
    apply=lambda xi, phi, action, context: xi + phi * context.index[:, None],
)


def smooth(theta, action):
    return theta[:, :1] * action + theta[:, 1:] * action**2


def jumping(theta, action):
    phase = 1e6 * theta.sum(1, keepdim=True) * (action + 3.1)
    return smooth(theta, action) + JUMP * torch.sin(phase)


def stepping(theta, action):
    """Smooth between two steps, with the slopes of what has none."""
    phase = 37 * theta.sum(1, keepdim=True) * (action + 3.1)
    return smooth(theta, action) + JUMP * torch.sign(torch.sin(phase))


def bending(theta, action):
    """Smooth, though its slopes change within a coarse step of differences."""
    return smooth(theta, action) + 0.04 * torch.sin(150 * theta[:, :1]) * action


def rough(fn, sd=NOISE, seed=0):
    theta = torch.tensor([[0.7, -0.4]], dtype=torch.float64)
    gen = torch.Generator().manual_seed(3)
    noise = torch.randn(8, 1, generator=gen, dtype=torch.float64)
    x = fn(theta, PLACES.double()) + sd * noise
    model = SimulatorModel(fn, noise=GaussianNoise(sd))
    return RivalSet(model, BOX, Trials(PLACES, x), [BIAS], seed=seed)


@pytest.mark.parametrize(("fn", "sd"), [(smooth, NOISE), (bending, 0.001)])
def test_a_smooth_simulator_has_no_jumps(fn, sd):
    found = rough(fn, sd)
    assert found.is_smooth
    assert found.step < 1e-2
    assert not found.roughness.any()
    assert found.noise.cells[0].sd == pytest.approx(sd)


@pytest.mark.parametrize("seed", [0, 1])
def test_jumps_have_their_size_and_count_as_noise(seed):
    found = rough(jumping, seed=seed)
    assert not found.is_smooth
    # The median of |sin| over that of |normal|, by its error from 64 draws.
    size = JUMP * np.sqrt(0.5) / 0.6745
    assert np.median(found.roughness) == pytest.approx(size, rel=0.2)
    assert found.noise.cells[0].sd == pytest.approx(np.hypot(NOISE, found.roughness))
    steps = rough(stepping, seed=seed)  # whose slopes agree between them
    assert not steps.is_smooth
    assert float(np.median(steps.roughness)) > NOISE


def test_repeated_actions_are_simulated_once_and_predict_the_same():
    seen = []

    def counting(theta, action):
        seen.append(len(theta))
        return jumping(theta, action)

    action = PLACES[[0, 3, 3, 5, 0, 7]]
    model = SimulatorModel(counting, noise=GaussianNoise(NOISE))
    own = AugmentedSimulator(model, [BIAS, DRIFT])
    simulator = TrialSimulator(own, Trials(action, torch.zeros(6, 1)))
    theta = BOX.sample((5,)).double()
    bias = torch.linspace(-1, 1, 5, dtype=torch.float64)[:, None]
    simulator.predict(theta[:1], {})  # effects are held to their nulls before
    seen.clear()
    mean, _, _ = simulator.predict(theta, {"bias": bias})
    every = jumping(theta.repeat_interleave(6, 0), action.double().repeat(5, 1))
    assert np.array_equal(mean, (every.reshape(5, 6) + bias).numpy())
    # What depends on the trial's place is no repetition.
    simulator.predict(theta, {"drift": bias + 3.14159})
    assert seen == [5 * 4, 5 * 6]


def test_a_random_simulator_is_not_merged():
    def draw(theta, action):
        return smooth(theta, action) + torch.randn(len(theta), 1)

    model = AugmentedSimulator(SimulatorModel(draw), [BIAS])
    x = model.evaluate(torch.zeros(64, 2), {}, torch.ones(64, 1), merge=True)
    assert len(x.unique()) > 32


def test_jumps_far_from_the_fit_are_none_there():
    def curve(theta, action):
        rough = torch.round(20 * theta) / 20
        return torch.where(theta.abs() > 0.5, rough, theta) * action

    prior = normal(2.0)
    model = SimulatorModel(curve, noise=GaussianNoise(0.01))
    action = torch.linspace(1, 2, 8)[:, None]
    some = RivalSet(model, prior, Trials(action, 0.1 * action), [])
    assert some.is_smooth
    assert not some.roughness.any()
    assert some.step <= 1e-3
    # The same where the fit is among the jumps.
    other = RivalSet(model, prior, Trials(action, 1.523 * action), [])
    assert not other.is_smooth
