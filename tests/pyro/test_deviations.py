"""Coordinates of the errors' deviations, beside sums over a grid."""

import numpy as np
import pytest
import torch

from sbi_active.pyro import SpikeAndSlab
from sbi_active.pyro.denoising import Coordinates, Predictive, _normalized

MODEL = SpikeAndSlab()
COV = torch.tensor([[1.0, 0.95], [0.95, 1.0]], dtype=torch.float64)
TWO = Predictive(
    torch.tensor([0.5, 0.5], dtype=torch.float64).log(),
    torch.tensor([[0.0, 0.0], [0.5, 0.0]], dtype=torch.float64),
    COV.expand(2, 2, 2),
)


def coordinates(target, seed=0):
    fit = TWO.marginal(torch.arange(2) < len(target))
    rng = np.random.default_rng(seed)
    return fit, Coordinates(fit, target, MODEL, rng)


def mass(values):
    return values / values.sum()


@pytest.mark.parametrize("x", [[0.3], [6.0], [0.4, 2.9], [0.4, 0.3]])
def test_a_channel_has_its_marginal_with_a_share_of_what_it_says_alone(x):
    target = torch.tensor(x, dtype=torch.float64)
    fit, found = coordinates(target)
    grid = torch.linspace(-9.2, 4.0, 400, dtype=torch.float64)
    prior = MODEL.log_deviation(grid)
    pairs = torch.cartesian_prod(*[grid] * len(target)).reshape(-1, len(target))
    log_p = fit.log_joint(target, pairs.exp()).logsumexp(-1)
    log_p = log_p + MODEL.log_deviation(pairs).sum(-1)
    shape = [len(grid)] * len(target)
    joint = mass((log_p - log_p.max()).exp()).reshape(shape)
    log_alone = fit.log_alone(target, grid.exp()[:, None].expand(-1, len(target)))
    alone = _normalized((0.3 * log_alone).numpy().T, prior.numpy())
    log_sd = grid[:, None].expand(-1, len(target))
    got = found.log_gain(log_sd) + prior[:, None]
    for c in range(len(target)):
        others = [k for k in range(len(target)) if k != c]
        exact = joint.sum(others) if others else joint
        tails = mass(torch.from_numpy(np.exp(alone[c])) * prior.exp())
        wanted = 0.9 * exact + 0.1 * tails
        assert float((mass(got[:, c].exp()) - wanted).abs().sum()) < 0.1
