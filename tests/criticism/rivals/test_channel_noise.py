"""Noise of which the size is unknown in each channel, against sums over all sizes."""

from itertools import product

import numpy as np
import pytest
import torch
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

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


def brute_force(noise, m, residual):
    """Log sums over the correlation time and the sizes of both channels."""
    grid = noise.posterior
    edges, nodes = grid.shared.edges.numpy(), grid.sd.nodes.numpy()
    terms = []
    for tau in np.sqrt(edges[1:] * edges[:-1]):
        for pair in product(*nodes):
            log_p = 0.0
            for trial, channel in product(np.unique(m.trial), (0, 1)):
                own = (m.trial == trial) & (m.channel == channel)
                apart = np.abs(m.time[own][:, None] - m.time[own])
                cov = pair[channel] ** 2 * np.exp(-apart / tau)
                log_p += multivariate_normal(np.zeros(own.sum()), cov).logpdf(
                    residual[own]
                )
            terms.append(log_p)
    return logsumexp(terms) - np.log(len(terms))


@pytest.mark.parametrize("gap", [False, True])
def test_evidence_is_the_sum_over_every_combination_of_sizes(gap):
    m = measured(gap=gap)
    noise = noise_of()
    grid = declared_noise(noise, m)
    assert grid.channel is not None
    got = grid.log_likelihood(m.x[None])[0]
    assert got == pytest.approx(brute_force(noise, m, m.x), rel=1e-9)
    posterior = grid.posterior(m.x)
    assert posterior.sum() == pytest.approx(1.0)


def test_with_a_settled_ratio_it_is_as_probable_where_the_ratio_is_from():
    m = measured()
    grid = declared_noise(noise_of(), m)
    assert grid.channel is not None
    settled = grid.settled(m.x)
    assert settled.log_likelihood(m.x[None])[0] == pytest.approx(
        grid.log_likelihood(m.x[None])[0]
    )
    sizes = settled.sizes(np.array([1.0, 2.0]))
    np.testing.assert_allclose(sizes[1], 2 * sizes[0])
    cell, best = grid.likeliest(m.x)
    np.testing.assert_allclose(
        settled.cells[cell].sd, grid.by_number(best[None])[0] * (grid.cells[cell].sd)
    )


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


def test_a_common_factor_is_summed_beside_the_sizes():
    m = measured()
    grid = declared_noise(noise_of(), m)
    scales, p = np.array([1.0, 2.0, 5.0]), np.log([0.5, 0.3, 0.2])
    wide = grid.scaled(scales, p)
    each = [grid.log_likelihood(m.x[None] / s)[0] - len(m) * np.log(s) for s in scales]
    assert wide.log_likelihood(m.x[None])[0] == pytest.approx(logsumexp(each + p))
    some = m.trial > 0
    later = Measurements.of(
        Trials(
            torch.arange(2.0),
            m.x.reshape(3, 2, 4)[1:].transpose(0, 2, 1),
            sample_times=TIMES,
        )
    )
    expected = declared_noise(noise_of(), later).scaled(scales, p)
    assert wide.part(some).log_likelihood(m.x[None, some])[0] == pytest.approx(
        expected.log_likelihood(later.x[None])[0]
    )


def test_predictions_have_the_density_of_each_channel():
    """Of one trial given cells and sizes, as of independent numbers by channel."""
    m = measured(1)
    noise = AutocorrelatedNoise.unknown(sd=SIZES, correlation_time=(1e-6, 2e-6))
    grid = declared_noise(noise, m)
    cells, sizes = np.zeros(2, dtype=int), np.array([[1.0, 2.0], [0.5, 1.5]])
    each = grid.by_number(sizes)
    got = grid.log_density(cells, each, np.repeat(m.x[None], 2, 0))
    expected = norm(0, each * grid.cells[0].sd).logpdf(m.x).sum(1)
    np.testing.assert_allclose(got, expected, rtol=1e-9)
