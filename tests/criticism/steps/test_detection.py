"""When the bare model raises an alarm: by its Bayes factor, or by its chi-square."""

import pytest
import torch
from sbi.utils import BoxUniform
from scipy.stats import kstest

from sbi_active import GaussianNoise, SimulatorModel, StudentTNoise
from sbi_active.criticism import Criticism, Trials
from sbi_active.criticism.steps.detection import LEVEL
from sbi_active.simulation import estimate_noise
from tests.effects import on_outcomes

NOISE = 0.1
PRIOR = BoxUniform(-3 * torch.ones(2), 3 * torch.ones(2))
CUBIC = on_outcomes("cubic", lambda x, phi, action, context: x + phi * action**3)


def line(theta, action):
    return theta[:, :1] + theta[:, 1:] * action


def criticism(x, action, *, noise=None, fn=line, prior=PRIOR):
    model = SimulatorModel(fn, noise=noise or GaussianNoise(NOISE))
    return Criticism(model, prior, Trials(action, x), effects=[CUBIC])


def zigzag(size):
    """A residual that no declared effect takes up, along the actions."""
    action = torch.linspace(-2, 2, 8)[:, None]
    return size * NOISE * torch.tensor([1.0, -1.0] * 4)[:, None], action


def test_the_chi_square_alone_raises_the_alarm_where_the_noise_is_known():
    x, action = zigzag(1.7)
    found = criticism(x, action).detect()
    assert found.p_value < LEVEL
    assert not found.by_evidence
    assert found.alarm
    repeats = NOISE * torch.randn(6, 1, generator=torch.Generator().manual_seed(0))
    free = criticism(x, action, noise=estimate_noise(repeats)).detect()
    assert free.level == 0.0
    heavy = criticism(x, action, noise=StudentTNoise(NOISE, df=4.0)).detect()
    assert heavy.level == 0.0


@pytest.mark.slow
def test_the_chi_square_of_clean_data_is_one():
    gen, p = torch.Generator().manual_seed(0), []
    for _ in range(24):
        theta = 2 * torch.rand(1, 2, generator=gen) - 1
        action = 4 * torch.rand(8, 1, generator=gen) - 2
        x = line(theta.expand(8, -1), action)
        x = x + NOISE * torch.randn(x.shape, generator=gen)
        p.append(criticism(x, action).detect().p_value)
    assert kstest(p, "uniform").pvalue > 0.01
