"""Steps of finite differences, and what a quadratic function leaves over."""

import numpy as np
import pytest
import torch
from torch.distributions import Independent, Normal

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Trials
from sbi_active.criticism.evidence.jumps import (
    _beside_quadratic,
    quadratic,
)
from sbi_active.criticism.evidence.rival_set import RivalSet


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


def test_quadratic_functions_leave_nothing_and_noise_its_deviation():
    rng = np.random.default_rng(0)
    u = rng.normal(size=(400, 3))
    basis = quadratic(u)
    assert basis.shape == (400, 10)
    assert np.linalg.matrix_rank(basis) == 10
    x = basis @ rng.normal(size=(10, 2))
    assert _beside_quadratic(u, x) == pytest.approx(0.0, abs=1e-9)
    noise = np.array([0.5, 2.0])
    found = _beside_quadratic(u, x + noise * rng.normal(size=x.shape))
    assert found == pytest.approx(noise, rel=0.15)
    # Of few rows the regression takes a share of the noise with it.
    few = _beside_quadratic(u[:20], rng.normal(size=(20, 500)))
    assert np.sqrt((few**2).mean()) == pytest.approx(1.0, abs=0.3)
    x[::2, 1] = np.nan  # lost rows are left out, and too few give nothing
    x[12:, 0] = np.nan
    assert _beside_quadratic(u, x)[0] == 0.0
    assert _beside_quadratic(u, x)[1] == pytest.approx(0.0, abs=1e-9)
