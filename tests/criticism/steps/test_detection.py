"""When the bare model raises an alarm: by its Bayes factor, or by its chi-square."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform
from scipy.stats import kstest
from torch.distributions import Normal

from sbi_active import GaussianNoise, SimulatorModel, StudentTNoise
from sbi_active.criticism import Criticism, Effect, Trials
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.steps.detection import LEVEL, is_found_again, num_determined
from sbi_active.simulation import estimate_noise

NOISE = 0.1
PRIOR = BoxUniform(-3 * torch.ones(2), 3 * torch.ones(2))
CUBIC = Effect(
    "cubic",
    hook="observation",
    prior=Normal(torch.zeros(1), torch.ones(1)),
    null=0.0,
    apply=lambda x, phi, action, context: x + phi * action**3,
)


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


def test_the_bare_model_is_searched_again_before_an_alarm():
    x, action = zigzag(0.0)
    loop = criticism(x + 5 * NOISE * action**3, action)
    assert loop.detect().by_evidence
    assert loop.detect().null_cross_check is None  # two searches agree


def test_a_mode_that_the_first_search_missed_is_no_alarm(monkeypatch):
    """The bare model fits at a second slope, of which an effect's fit knows."""
    action = torch.linspace(-2, 2, 8)[:, None]
    gen = torch.Generator().manual_seed(0)
    truth = torch.tensor([[0.5, 1.0]]).expand(8, -1)
    x = line(truth, action) + NOISE * torch.randn(8, 1, generator=gen)
    loop = criticism(x, action)
    rivals = loop.rivals
    right = rivals.fit()
    assert is_found_again(rivals)
    wrong = replace(right.sample, u=right.sample.u + 2.0)
    monkeypatch.setitem(rivals.fits, ModelKey(), replace(right, sample=wrong))
    rivals.fit(ModelKey(("cubic",)))
    assert not is_found_again(rivals)


def test_a_parameter_that_changes_nothing_takes_up_no_residual():
    x, action = zigzag(1.0)
    both = criticism(x, action)
    idle = criticism(x, action, fn=lambda theta, xi: theta[:, :1] + 0 * xi)
    assert np.isclose(num_determined(both.rivals), 2.0, atol=0.05)
    # The variance of 400 draws of the idle one has a relative error of about .07.
    assert np.isclose(num_determined(idle.rivals), 1.0, atol=0.25)


def test_what_an_effect_leaves_over_is_undeclared_beside_it():
    x, action = zigzag(2.2)
    made = criticism(x + 3.0 * action**3, action).report(evaluate=False)
    assert made.verdict == "cubic"
    assert made.tracing.misfit.size > 2  # the error beside it, in sensor deviations
    assert not made.tracing.misfit.passes
    assert "cubic, probably the cause" in str(made).splitlines()[0]
    after = made.residuals_after.refitted
    assert np.nanstd(after) < np.nanstd(made.residuals.refitted)


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
