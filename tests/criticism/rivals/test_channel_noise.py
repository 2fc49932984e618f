"""Noise of which the size is unknown in each channel: fits tell the ratio."""

import numpy as np
import pytest
import torch
from scipy.special import logsumexp
from scipy.stats import norm

from sbi_active import AutocorrelatedNoise, SimulatorModel
from sbi_active.criticism import Effect, Trials, close_loop
from sbi_active.criticism.data import Measurements
from sbi_active.criticism.rivals.noise_grid import declared_noise

TIMES = np.array([0.0, 0.1, 0.3, 0.6])
SIZES = [(0.1, 3.0), (10.0, 300.0)]


def noise_of(**options):
    return AutocorrelatedNoise.unknown(
        sd=SIZES, correlation_time=(0.05, 2.0), num_sds=6, num_times=3, **options
    )


def measured(num=3, *, unit=(0.5, 40.0), seed=0, gap=False):
    gen = torch.Generator().manual_seed(seed)
    x = torch.randn(num, 4, 2, generator=gen).double() * torch.tensor(unit).double()
    if gap:
        x[0, 1, 0] = float("nan")
    return Measurements.of(Trials(torch.arange(float(num)), x, sample_times=TIMES))


def test_only_the_ratio_of_the_sizes_is_left_to_fits():
    m = measured()
    grid = declared_noise(noise_of(), m)
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
    model = SimulatorModel(
        gliding,
        noise=AutocorrelatedNoise.unknown(
            sd=[(1e-3, 1.0), (1.0, 1e3)], correlation_time=(0.02, 3.0)
        ),
        channel_names=["place", "speed"],
        sample_times=times,
    )
    kind = torch.distributions.HalfNormal(torch.tensor([0.3]))
    report = close_loop(
        model,
        torch.distributions.Independent(
            torch.distributions.Uniform(torch.zeros(1), 2 * torch.ones(1)), 1
        ),
        Trials(action, x, sample_times=times),
        effects=[
            Effect.keyword("drag", prior=torch.distributions.Independent(kind, 1))
        ],
        seed=0,
        evaluate=False,
        plan=False,
    )
    assert report.tracing.verdict == ("drag" if drag else "none")
    if drag:
        (phi,) = (e for e in report.tracing.estimates if e.name == "drag")
        assert abs(phi.mean - drag) < 4 * phi.sd


def test_predictions_have_the_density_of_each_channel():
    """Of one trial given cells and sizes, as of independent numbers by channel."""
    m = measured(1)
    noise = AutocorrelatedNoise.unknown(sd=SIZES, correlation_time=(1e-6, 2e-6))
    grid = declared_noise(noise, m).sized([np.array([0.5, 40.0])[m.channel]])
    cells, sizes = np.zeros(2, dtype=int), np.array([1.0, 1.5])
    got = grid.log_density(cells, sizes, np.repeat(m.x[None], 2, 0))
    expected = norm(0, sizes[:, None] * grid.cells[0].sd).logpdf(m.x).sum(1)
    np.testing.assert_allclose(got, expected, rtol=1e-9)
