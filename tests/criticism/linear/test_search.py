"""Where fits of sets of effects begin."""

import numpy as np
import torch
from sbi.utils import BoxUniform
from torch import Tensor
from torch.distributions import Independent, Normal, Uniform

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Criticism, Effect, Trials
from sbi_active.criticism.linear.fits import FitSettings, sensor_of
from sbi_active.criticism.linear.search import Search
from sbi_active.criticism.results import ModelKey

SENSOR, NUM_TRIALS, LIMIT, SLOPE = 0.5, 14, 14.0, 2.0


def curve(theta: Tensor, action: Tensor) -> Tensor:
    a = action[:, :1].to(theta)
    return theta[:, :1] * torch.exp(3 - a) + theta[:, 1:] * a


def drifting(x: Tensor, phi: Tensor, action: Tensor, context) -> Tensor:
    return x + phi * context.index[:, None]


EFFECTS = [
    Effect(
        "limit",
        hook="observation",
        prior=Independent(Uniform(torch.tensor([0.0]), torch.tensor([4.0])), 1),
        null=torch.inf,
        apply=lambda x, phi, action, context: x.clamp(-phi.exp(), phi.exp()),
        units="log",
    ),
    Effect(
        "drift",
        hook="observation",
        prior=Normal(0.0, 1.0),
        null=0.0,
        apply=drifting,
        units="",
    ),
]


def loop():
    generator = torch.Generator().manual_seed(0)
    action = 8 * torch.rand(NUM_TRIALS, 1, generator=generator) - 2
    index = torch.arange(NUM_TRIALS)
    theta = torch.tensor([[-1.9, -4.3]]).expand(NUM_TRIALS, -1)
    x = curve(theta, action).clamp(-LIMIT, LIMIT) + SLOPE * index[:, None]
    x = x + SENSOR * torch.randn(x.shape, generator=generator)
    return Criticism(
        SimulatorModel(curve, noise=GaussianNoise(SENSOR), batched=True),
        BoxUniform(-5 * torch.ones(2), 5 * torch.ones(2)),
        Trials(action, x, index=index),
        effects=EFFECTS,
        seed=0,
    )


def test_parameters_beside_an_effect_without_a_null_are_looked_for_anew():
    """Without the limit the exponential has to vanish, with it it is all there is."""
    rivals = loop().rivals
    search = Search(rivals, sensor_of(rivals))
    search.fit_singles()
    alone = search.found[ModelKey(("drift",))].model.rms
    both = search.fit_set(ModelKey(("limit", "drift"))).model.rms
    assert alone > 5
    assert both < 1 + 3 / np.sqrt(2 * NUM_TRIALS)


def test_no_pair_is_fitted_where_linear_evidence_puts_all_behind():
    rivals = loop().rivals
    search = Search(rivals, sensor_of(rivals), FitSettings(behind=-np.inf))
    search.fit_singles()
    search.fit_larger()
    assert max(len(key.effects) for key in search.found) == 1
