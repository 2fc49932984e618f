"""Where fits of sets of effects begin."""

import numpy as np
import torch
from sbi.utils import BoxUniform
from torch.distributions import Independent, Uniform

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Criticism, Trials
from sbi_active.criticism.linear.fits import FitSettings
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.results import ModelKey
from tests.effects import on_outcomes

SENSOR, NUM_TRIALS, LIMIT, SLOPE = 0.5, 14, 14.0, 2.0


def curve(theta, action):
    a = action[:, :1].to(theta)
    return theta[:, :1] * torch.exp(3 - a) + theta[:, 1:] * a


EFFECTS = [
    on_outcomes(
        "limit",
        lambda x, phi, action, context: x.clamp(-phi.exp(), phi.exp()),
        prior=Independent(Uniform(torch.tensor([0.0]), torch.tensor([4.0])), 1),
        null=torch.inf,
    ),
    on_outcomes("drift", lambda x, phi, action, c: x + phi * c.index[:, None]),
]


def searched(**settings):
    generator = torch.Generator().manual_seed(0)
    action = 8 * torch.rand(NUM_TRIALS, 1, generator=generator) - 2
    theta = torch.tensor([[-1.9, -4.3]]).expand(NUM_TRIALS, -1)
    drift = SLOPE * torch.arange(NUM_TRIALS)[:, None]
    x = curve(theta, action).clamp(-LIMIT, LIMIT) + drift
    x = x + SENSOR * torch.randn(x.shape, generator=generator)
    model = SimulatorModel(curve, noise=GaussianNoise(SENSOR))
    prior = BoxUniform(-5 * torch.ones(2), 5 * torch.ones(2))
    loop = Criticism(model, prior, Trials(action, x), effects=EFFECTS, seed=0)
    search = Search(loop.rivals, FitSettings(**settings))
    search.fit_singles()
    return search


def test_parameters_beside_an_effect_without_a_null_are_looked_for_anew():
    """Without the limit the exponential has to vanish, with it it is all there is."""
    search = searched()
    alone = search.found[ModelKey(("drift",))].model.rms
    both = search.fit_set(ModelKey(("limit", "drift"))).model.rms
    assert alone > 5
    assert both < 1 + 3 / np.sqrt(2 * NUM_TRIALS)


def test_no_pair_is_fitted_where_linear_evidence_puts_all_behind():
    search = searched(behind=-np.inf)
    search.fit_larger()
    assert max(len(key.effects) for key in search.found) == 1
