"""A library of 24 effects, whose sets are all fitted, and one of 25 say the same."""

import numpy as np
import torch
from sbi.utils import BoxUniform
from torch.distributions import Normal

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Criticism, Effect, Trials
from sbi_active.criticism.steps.equivalence import MANY

TIMES = torch.linspace(0, 2, 30)
PRIOR = BoxUniform(torch.tensor([-2.0]), torch.tensor([2.0]))


def series(theta, action):
    return theta * action * TIMES


def pattern(k):
    wave = (torch.cos, torch.sin)[k % 2](3 * (1 + k // 2) * TIMES)
    return Effect(
        f"wave {k}",
        hook="observation",
        prior=Normal(0.0, 0.3),
        null=0.0,
        apply=lambda x, phi, action, context: x + phi * wave,
        family="wave",
    )


def verdict(number, strength):
    rng = np.random.default_rng(7)
    model = SimulatorModel(series, noise=GaussianNoise(0.05))
    action = torch.tensor([[0.5], [1.0], [1.5]])
    x = series(torch.tensor([[0.7]]), action) + strength * torch.cos(6 * TIMES)
    x = x + 0.05 * torch.from_numpy(rng.standard_normal(x.shape)).float()
    effects = [pattern(k) for k in range(number)]
    loop = Criticism(model, PRIOR, Trials(action, x), effects=effects, seed=0)
    return loop.trace()


def test_clean_trials_of_many_effects_say_none():
    assert verdict(MANY + 1, 0.0).verdict == "none"


def test_one_effect_more_does_not_change_the_verdict():
    few, many = (verdict(MANY + k, 0.2) for k in (0, 1))
    assert few.verdict == many.verdict == "wave 2"
    assert abs(few.inclusion["wave 2"] - many.inclusion["wave 2"]) < 0.1
