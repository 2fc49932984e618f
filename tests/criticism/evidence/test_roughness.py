"""A simulator that jumps: what its jumps count as, and evidence beside them."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import Independent, Normal

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import AugmentedSimulator, Effect, Trials
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator
from tests.effects import BIAS

NOISE, JUMP = 0.1, 0.2
PRIOR = BoxUniform(-2 * torch.ones(2), 2 * torch.ones(2))
ACTION = torch.tensor([-2.0, -1.5, -1.0, -0.5, 0.5, 1.0, 1.5, 2.0])[:, None]
DRIFT = Effect(
    "drift",
    hook="action",
    prior=Independent(Normal(torch.zeros(1), torch.ones(1)), 1),
    null=0.0,
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


def rivals(fn, *, seed=0, missing=0.0, sd=NOISE):
    theta = torch.tensor([[0.7, -0.4]], dtype=torch.float64)
    gen = torch.Generator().manual_seed(3)
    noise = torch.randn(8, 1, generator=gen, dtype=torch.float64)
    x = fn(theta, ACTION.double()) + missing + sd * noise
    model = SimulatorModel(fn, noise=GaussianNoise(sd))
    return RivalSet(model, PRIOR, Trials(ACTION, x), [BIAS], seed=seed)


def test_a_smooth_simulator_has_none():
    found = rivals(smooth)
    assert found.is_smooth
    assert not found.roughness.any()
    assert found.noise.cells[0].sd == pytest.approx(NOISE)


@pytest.mark.parametrize("seed", [0, 1])
def test_jumps_have_their_size_and_count_as_noise(seed):
    found = rivals(jumping, seed=seed)
    assert not found.is_smooth
    # The median of |sin| over that of |normal|, by its error from 64 draws.
    assert np.median(found.roughness) == pytest.approx(
        JUMP * np.sqrt(0.5) / 0.6745, rel=0.2
    )
    assert found.noise.cells[0].sd == pytest.approx(np.hypot(NOISE, found.roughness))


@pytest.mark.parametrize("seed", range(2))
def test_steps_are_jumps_though_the_slopes_between_them_agree(seed):
    found = rivals(stepping, seed=seed)
    assert not found.is_smooth
    assert float(np.median(found.roughness)) > NOISE


@pytest.mark.parametrize("seed", range(2))
def test_a_response_that_bends_does_not_jump(seed):
    found = rivals(bending, seed=seed, sd=0.001)
    assert found.is_smooth
    assert found.step < 1e-2
    assert not found.roughness.any()


def test_repeated_actions_are_simulated_once_and_predict_the_same():
    seen = []

    def counting(theta, action):
        seen.append(len(theta))
        return jumping(theta, action)

    action = ACTION[[0, 3, 3, 5, 0, 7]]
    trials = Trials(action, torch.zeros(6, 1))
    model = SimulatorModel(counting, noise=GaussianNoise(NOISE))
    simulator = TrialSimulator(AugmentedSimulator(model, [BIAS, DRIFT]), trials)
    theta = PRIOR.sample((5,)).double()
    phi = {"bias": torch.linspace(-1, 1, 5, dtype=torch.float64)[:, None]}
    simulator.predict(theta[:1], {})  # effects are held to their nulls before
    seen.clear()
    mean, _, _ = simulator.predict(theta, phi)
    assert seen == [5 * 4]
    expected = (
        jumping(theta.repeat_interleave(6, 0), action.double().repeat(5, 1)).reshape(
            5, 6
        )
        + phi["bias"]
    )
    assert np.array_equal(mean, expected.numpy())
    # What depends on the trial's place is no repetition.
    seen.clear()
    simulator.predict(theta, {"drift": phi["bias"] + 3.14159})
    assert seen == [5 * 6]


def test_a_random_simulator_is_not_merged():
    def draw(theta, action):
        return smooth(theta, action) + torch.randn(len(theta), 1)

    model = AugmentedSimulator(SimulatorModel(draw), [BIAS])
    theta = torch.zeros(64, 2)
    x = model.evaluate(theta, {}, torch.ones(64, 1), merge=True)
    assert len(x.unique()) > 32


def test_jumps_far_from_the_fit_are_none_there():
    def curve(theta, action):
        rough = torch.round(20 * theta) / 20
        return torch.where(theta.abs() > 0.5, rough, theta) * action

    prior = Independent(Normal(torch.zeros(1), 2 * torch.ones(1)), 1)
    model = SimulatorModel(curve, noise=GaussianNoise(0.01))
    action = torch.linspace(1, 2, 8)[:, None]
    some = RivalSet(model, prior, Trials(action, 0.1 * action), [])
    assert some.is_smooth
    assert not some.roughness.any()
    assert some.step <= 1e-3
    # The same where the fit is among the jumps.
    other = RivalSet(model, prior, Trials(action, 1.523 * action), [])
    assert not other.is_smooth
