"""Jumps that lie between few rows: a belief is right, or says that it may not be."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import (
    BoxActions,
    Campaign,
    CampaignOptions,
    GaussianNoise,
    SimulatorModel,
)
from sbi_active.inference.emulation.emulator import emulated
from sbi_active.inference.emulation.pool import TrialRows
from sbi_active.inference.emulation.solving import whole_space
from sbi_active.inference.emulation.stages import largest_error
from sbi_active.inference.engine.learned import learned_fit
from sbi_active.inference.sampling.coordinates import PriorCoordinates

EDGE = -0.4


def belief_of(response, seed):
    """Return the belief of two trials, each a slope and a response beside it."""

    def fn(theta, xi):
        return theta[:, :1] * xi + 3 * response(theta[:, 1:] - EDGE)

    simulator = SimulatorModel(fn, noise=GaussianNoise(0.1))
    prior = BoxUniform(-torch.ones(2), torch.ones(2))
    options = CampaignOptions(max_simulations=300, planned_trials=2)
    campaign = Campaign(
        simulator, prior, BoxActions([0.5], [1.5]), options=options, seed=seed
    )
    truth = torch.tensor([[0.3, EDGE + 0.05]])
    for xi in (0.7, 1.3):
        action = torch.tensor([[xi]])
        campaign.attach(action[0], fn(truth, action)[0])
    return campaign.update()


@pytest.mark.parametrize("seed", [0, 1])
def test_a_jump_is_followed_or_said_to_be_missed(seed):
    """Beyond the jump the second parameter changes nothing: it may be anywhere."""
    belief = belief_of(lambda off: (off > 0).float(), seed)
    middle, sd = 0.5 * (1 + EDGE), (1 - EDGE) / 12**0.5
    is_right = abs(float(belief.mean[1]) - middle) < 0.3 * sd
    assert is_right or not belief.diagnostics.trustworthy


def test_a_steep_response_that_rows_resolve_is_trusted():
    belief = belief_of(lambda off: torch.sigmoid(off / 0.1), 0)
    assert belief.diagnostics.trustworthy


def rows_of(function):
    """Return rows of a trial whose outcome is 0."""
    z = np.linspace(-1, 1, 31)[:, None] ** 3
    x, none = function(z), np.zeros((0, 2), dtype=int)
    agrees, used = np.ones(len(z), dtype=bool), np.ones(1, dtype=bool)
    return TrialRows(torch.zeros(1), z, x, np.zeros(1), used, agrees, none)


def test_the_error_of_a_learned_likelihood_is_what_simulations_say():
    prior = BoxUniform(-torch.ones(1), torch.ones(1))
    coordinates = PriorCoordinates(prior, np.random.default_rng(0))
    rows = rows_of(lambda z: z)
    noise = GaussianNoise(0.1)
    known = {"noise": noise, "x_shape": (1,)}
    learned = emulated(coordinates, whole_space(1), [rows], **known)
    fit = learned_fit(learned, np.random.default_rng(0))
    z = rows.z[11:20]  # within a deviation or two
    assert largest_error([fit], learned, [rows], z) < 0.01
    jumps = replace(rows, x=np.where(rows.z > 0, 5.0, rows.x))
    assert largest_error([fit], learned, [jumps], z) > 3
    lost = replace(rows, agrees=rows.z[:, 0] < 0)
    assert largest_error([fit], learned, [lost], z) > 3
    nothing = replace(rows, agrees=np.zeros(len(rows.z), dtype=bool))
    assert largest_error([fit], learned, [nothing], z) == np.inf
    assert largest_error([fit], learned, [rows], z + 1e-3) == np.inf
