"""Derivatives of a linearized model."""

import numpy as np
import torch
from sbi.utils import BoxUniform

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Trials
from sbi_active.criticism.linear.model import centered, linearize
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.rival_set import RivalSet

PRIOR = BoxUniform(torch.tensor([1.0, 0.5]), torch.tensor([20.0, 2.0]))
SD = 1e-6


def rival():
    def saturating(theta, xi):
        return torch.tanh(0.1 * xi * theta[:, :1] * theta[:, 1:])

    model = SimulatorModel(saturating, noise=GaussianNoise(SD))
    xi = torch.linspace(0.5, 1.5, 8)[:, None]
    trials = Trials(xi, torch.tanh(0.99 * xi))
    return RivalSet(model, PRIOR, trials, []).rival(ModelKey())


def test_at_a_bound_the_slope_is_from_within():
    own, unit = rival(), np.full(8, SD)
    for corner in (own.coordinates.low, own.coordinates.high):
        one_sided = linearize(own, corner, unit)
        both = centered(own, one_sided, unit)
        np.testing.assert_allclose(both.jacobian, one_sided.jacobian)
        assert np.isfinite(both.jacobian).all()
