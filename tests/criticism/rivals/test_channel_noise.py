"""Noise of which the size is unknown in each channel: fits tell the ratio."""

import numpy as np
import pytest
import torch
from scipy.special import logsumexp
from torch.distributions import Independent, Uniform

from sbi_active import AutocorrelatedNoise, SimulatorModel
from sbi_active.criticism import Criticism, Effect, Trials
from sbi_active.criticism.data import Measurements
from sbi_active.criticism.rivals.error_models import declared_noise
from tests.effects import half

TIMES = np.array([0.0, 0.1, 0.3, 0.6])


def test_only_the_ratio_of_the_sizes_is_left_to_fits():
    gen, unit = torch.Generator().manual_seed(0), torch.tensor([0.5, 40.0]).double()
    x = torch.randn(3, 4, 2, generator=gen).double() * unit
    m = Measurements.of(Trials(torch.arange(3.0), x, sample_times=TIMES))
    given = {"correlation_time": (0.05, 2.0), "num_sds": 6, "num_times": 3}
    noise = AutocorrelatedNoise.unknown(sd=[(0.1, 3.0), (10.0, 300.0)], **given)
    grid = declared_noise(noise, m)
    assert grid.is_by_channel
    sizes = [np.array(own)[m.channel] for own in ((0.5, 40.0), (0.2, 60.0))]
    sized = grid.sized(sizes)
    assert len(sized.cells) == 2 * len(grid.cells) == 6
    # Half of the common factors are on either side of the sizes that fits tell.
    assert np.exp(np.log(sized.scales).mean()) == pytest.approx(1.0)
    each = [grid.sized([own]).log_likelihood(m.x[None])[0] for own in sizes]
    expected = logsumexp(each) - np.log(2)
    assert sized.log_likelihood(m.x[None])[0] == pytest.approx(expected)


def gliding(theta, action, *, times, drag=0.0):
    """Place in m and speed in mm/s of what is pushed off, and slows down."""
    drag = torch.as_tensor(drag, dtype=theta.dtype).reshape(-1, 1)
    speed = action * torch.exp(-theta * times) / (1 + drag * action * times)
    return torch.stack([speed * times, 1e3 * speed], -1)


@pytest.mark.parametrize("drag", [0.0, 0.6])
def test_the_loop_names_an_effect_beside_errors_of_unknown_size_in_two_units(drag):
    times = torch.linspace(0.1, 3, 15, dtype=torch.float64)
    gen = torch.Generator().manual_seed(4)
    action = torch.linspace(0.5, 2, 6, dtype=torch.float64)[:, None]
    theta = torch.full((6, 1), 0.5, dtype=torch.float64)
    error = torch.randn(6, 15, 2, generator=gen, dtype=torch.float64)
    x = gliding(theta, action, times=times, drag=drag)
    x = x + error * torch.tensor([0.02, 15.0], dtype=torch.float64)
    sizes = {"sd": [(1e-3, 1.0), (1.0, 1e3)], "correlation_time": (0.02, 3.0)}
    noise = AutocorrelatedNoise.unknown(**sizes)
    model = SimulatorModel(gliding, noise=noise, sample_times=times)
    prior = Independent(Uniform(torch.zeros(1), 2 * torch.ones(1)), 1)
    trials = Trials(action, x, sample_times=times)
    effects = [Effect.keyword("drag", prior=half(0.3))]
    tracing = Criticism(model, prior, trials, effects=effects, seed=0).trace()
    assert tracing.verdict == ("drag" if drag else "none")
    if drag:
        (phi,) = (e for e in tracing.estimates if e.name == "drag")
        assert abs(phi.mean - drag) < 4 * phi.sd
