"""Errors of rivals, declared or a process, against densities summed by hand."""

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform
from scipy import stats
from scipy.stats import multivariate_normal
from torch.distributions import Independent, LogNormal, Normal, Uniform

from sbi_active import GaussianNoise, SimulatorModel, estimate_noise
from sbi_active.criticism import Criticism, Effect, Trials
from sbi_active.criticism.data.measurements import Measurements
from sbi_active.criticism.rivals.coordinates import SearchCoordinates
from sbi_active.criticism.rivals.error_models import (
    INDEPENDENT,
    NUM_DRAWS,
    NoiseCell,
    NoiseGrid,
    declared_noise,
    measurement_sds,
)
from sbi_active.criticism.rivals.residual_process import TIME_LENGTH, ResidualProcess
from sbi_active.simulation import AutocorrelatedNoise
from tests.effects import effect, half, normal

TIMES = np.array([0.0, 0.1, 0.3, 0.6, 1.0])


def trajectories():
    x = torch.tensor([[0.1, 0.4, torch.nan, 0.2, -0.3], [1.0, 0.9, 0.5, 0.4, 0.2]])
    return Measurements.of(Trials([0.0, 1.0], x, sample_times=TIMES))


def correlated(m, sd, tau):
    """Return the exact log density of the measurements as correlated noise."""
    log_p = 0.0
    for trial in np.unique(m.trial):
        at = m.trial == trial
        gap = np.abs(m.time[at][:, None] - m.time[at])
        cov = sd**2 * (np.exp(-gap / tau) if tau > 0 else np.eye(at.sum()))
        log_p += multivariate_normal(np.zeros(at.sum()), cov).logpdf(m.x[at])
    return log_p


def test_an_open_correlation_is_none_or_of_any_time():
    m = trajectories()
    # Half a sample step to twice the recording, log-uniform.
    times = np.geomspace(0.5 * m.step, 2 * 1.0, 14)
    each = [correlated(m, 0.7, tau) for tau in (0.0, *times)]
    weights = [INDEPENDENT, *14 * [(1 - INDEPENDENT) / 14]]
    expected = np.logaddexp.reduce(np.array(each) + np.log(weights))
    got = declared_noise(GaussianNoise(0.7), m).log_likelihood(m.x[None])[0]
    assert got == pytest.approx(expected, rel=1e-6)


def log_likelihood(noise, m):
    return declared_noise(noise, m).log_likelihood(m.x[None])[0]


def test_each_channel_has_its_own_deviation():
    x = torch.tensor([[1.0, torch.nan, 3.0], [0.5, -20.0, 10.0]])
    m = Measurements.of(Trials([0.0, 1.0], x))
    sd = torch.tensor([1.0, 10.0, 5.0])
    expected = stats.norm(0, sd).logpdf(x)[x.isfinite()].sum()
    assert log_likelihood(GaussianNoise(sd), m) == pytest.approx(expected)
    for wrong, message in ((sd[:2], "for each of 3 channels; got 2"), (0.0, "noise")):
        with pytest.raises(ValueError, match=message):
            declared_noise(GaussianNoise(wrong), m)


def test_unknown_size_and_correlation_are_summed_on_their_grid():
    m, each = trajectories(), []
    given = {"correlation_time": (0.05, 2.0), "num_sds": 9, "num_times": 5}
    noise = AutocorrelatedNoise.unknown(sd=(0.1, 3.0), **given)
    for sd in 0.1 * 30 ** ((np.arange(9) + 0.5) / 9):
        for tau in 0.05 * 40 ** ((np.arange(5) + 0.5) / 5):
            each.append(correlated(m, sd, tau))
    expected = np.logaddexp.reduce(each) - np.log(len(each))
    assert log_likelihood(noise, m) == pytest.approx(expected, rel=1e-6)


def test_errors_that_are_known_by_channel_have_their_units_along_a_trajectory():
    gen = torch.Generator().manual_seed(0)
    unit = torch.tensor([1.0, 500.0]).double()
    x = torch.randn(2, 5, 2, generator=gen).double() * unit
    m = Measurements.of(Trials([0.0, 1.0], x, sample_times=TIMES))
    noise = AutocorrelatedNoise(0.7 * unit, 0.4, measurement_sd=0.1 * unit)
    cov = 0.49 * np.exp(-np.abs(TIMES[:, None] - TIMES) / 0.4)
    series = (x / unit).permute(0, 2, 1).reshape(4, 5)
    expected = multivariate_normal(cov=cov).logpdf(series).sum()
    expected -= 10 * float(unit.log().sum())
    assert log_likelihood(noise, m) == pytest.approx(expected, rel=1e-9)
    np.testing.assert_allclose(measurement_sds(noise, m), 0.1 * unit.numpy()[m.channel])
    assert measurement_sds(GaussianNoise(1.0), m) is None
    assert measurement_sds(AutocorrelatedNoise(1.0, 0.4, measurement_sd=0.2), m) == 0.2


def test_a_posterior_over_the_size_is_summed_out_by_draws():
    repeats = 0.3 * torch.randn(60, 1, generator=torch.Generator().manual_seed(0))
    m = Measurements.of(Trials([0.0, 1.0, 2.0], [0.3, -0.4, 0.5]))
    # Numbers that share one unknown size are a multivariate t together.
    scale = float(repeats.std()) ** 2 * np.eye(3)
    expected = stats.multivariate_t(np.zeros(3), scale, df=59).logpdf(m.x)
    # A size known to 9 % has a density known to .16 nats a draw, here.
    found = log_likelihood(estimate_noise(repeats), m)
    assert found == pytest.approx(expected, abs=0.15)
    # Its draws may have no axis of parameters.
    size = torch.distributions.LogNormal(np.log(0.3), 0.1)
    grid = declared_noise(GaussianNoise(0.3, posterior=size), m)
    assert [cell.sd.shape for cell in grid.cells] == NUM_DRAWS * [(3,)]


# Noise of which the size is unknown in each channel: fits tell the ratio


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
        phi, sd = tracing.evidences["drag"].moments["drag"]
        assert abs(phi - drag) < 4 * sd


# The residual process against Gaussians of the stated covariance


ACTION = torch.linspace(-2, 2, 8)[:, None]
X = torch.tensor([0.3, 1.4, -0.2, 0.8, 2.2, 1.1, 3.5, 2.9])[:, None]
XI = ACTION[:, 0].double().numpy()
AMPLITUDES = np.geomspace(1, 20, 10)


M = Measurements.of(Trials(ACTION, X))
R, PLACE = X[:, 0].double().numpy(), ACTION.double().numpy() / 4
AT = {"largest": 20.0, "lengths": (0.3,)}


def covariance(points, others):
    """Return the kernel of two sets of places, shape (n, m)."""
    return np.exp(-0.5 * ((points[:, None] - others) / 0.3) ** 2)


KERNEL = covariance(PLACE[:, 0], PLACE[:, 0])


def mixed(covariances, r=R):
    """Return the log of the mean density of Gaussians."""
    each = [multivariate_normal(cov=cov).logpdf(r) for cov in covariances]
    return np.logaddexp.reduce(each) - np.log(len(each))


SPREAD = np.exp(3 * XI)


@pytest.mark.parametrize("spread", [None, SPREAD])
def test_the_residual_process_is_a_gaussian_of_the_stated_covariance(spread):
    """It may grow with the prediction."""
    noise = declared_noise(GaussianNoise(0.5), M)
    process = ResidualProcess(noise, M, action=PLACE, spread=spread, **AT)
    sizes = [np.full(8, 0.5)]
    if spread is not None:
        sizes.append(spread * np.median(0.5 / spread))
    expected = mixed(
        a**2 * KERNEL * np.outer(b, b) + 0.25 * np.eye(8)
        for a in AMPLITUDES
        for b in sizes
    )
    # Directions below 1e-5 of the variance are left out.
    assert process.log_likelihood(R[None])[0] == pytest.approx(expected, abs=1e-2)


def test_one_process_follows_the_order_of_the_trials():
    noise, order = declared_noise(GaussianNoise(0.5), M), np.arange(8) / 7
    action = np.random.default_rng(0).permutation(PLACE)
    each = [
        ResidualProcess(noise, M, action=place, **AT).log_likelihood(R[None])[0]
        for place in (action, order[:, None])
    ]
    both = ResidualProcess(noise, M, action=action, order=order, **AT)
    expected = np.logaddexp(*each) - np.log(2)
    assert both.log_likelihood(R[None])[0] == pytest.approx(expected)
    # A slow drift is carried on for a while.
    drift, later = 4 * np.sin(2 * order), np.append(order, order[-1] + 0.05)
    there = np.concatenate([action, action[:1]])
    one = Measurements.of(Trials(ACTION[:1], X[:1]))
    mean, _ = both.condition(drift[None], one, there, order=later)
    assert mean[0, 0] == pytest.approx(4 * np.sin(2 * later[-1]), abs=0.5)


def test_the_best_process_is_interpolated_with_its_own_uncertainty():
    # Half of the deviation and a factor of two.
    noise = NoiseGrid([NoiseCell.of(M, sd=np.full(8, 0.25))], scales=np.array([2.0]))
    process = ResidualProcess(noise, M, action=PLACE, **AT)

    def total(a):
        return 0.25 * (a**2 * KERNEL + np.eye(8))

    there = np.array([-0.45, 0.1, 0.3])
    new = Measurements.of(Trials(4 * there[:, None], np.zeros((3, 1))))
    everywhere = np.concatenate([PLACE, there[:, None]])
    mean, sd = process.condition(np.stack([R, 2 * R]), new, everywhere)
    # The amplitude is that of the mean residual, 1.5 r.
    best = max(process.amplitudes, key=lambda a: mixed([total(a)], 1.5 * R))
    assert best > AMPLITUDES[0]
    across = 0.25 * best**2 * covariance(there, PLACE[:, 0])
    weight = across @ np.linalg.inv(total(best))
    np.testing.assert_allclose(mean, np.stack([weight @ R, 2 * weight @ R]), rtol=1e-6)
    variance = 0.25 * best**2 - np.einsum("mi,mi->m", weight, across)
    np.testing.assert_allclose(sd**2, variance, rtol=1e-6)


def test_trajectories_are_smooth_in_action_and_time():
    x = np.random.default_rng(0).normal(size=(3, 5))
    times = np.linspace(0, 1, 5)
    m = Measurements.of(Trials([0.0, 1.0, 2.0], x, sample_times=times))
    noise = NoiseGrid([NoiseCell.of(m, sd=np.full(15, 0.3), correlation_time=0.2)])
    place = np.array([[0.0], [0.2], [1.0]])
    process = ResidualProcess(noise, m, action=place, **AT)
    apart = (place[m.trial] - place[m.trial].T) / 0.3
    later, same = m.time[:, None] - m.time, m.trial[:, None] == m.trial
    smooth = np.exp(-0.5 * apart**2 - 0.5 * (later / TIME_LENGTH) ** 2)
    rough = np.where(same, np.exp(-np.abs(later) / 0.2), 0.0)
    expected = mixed((0.09 * (a**2 * smooth + rough) for a in AMPLITUDES), m.x)
    assert process.log_likelihood(m.x[None])[0] == pytest.approx(expected, abs=2e-2)


# Coordinates of a search: densities against closed forms, and what is where


BOX = BoxUniform(torch.tensor([1.0]), torch.tensor([3.0]))
WIDE_ONE = effect("wide", prior=LogNormal(torch.zeros(1), 2 * torch.ones(1)))
START = effect("start", prior=Normal(torch.zeros(2), torch.ones(2)), scope="trial")


def coordinates(num_trials=3):
    return SearchCoordinates(BOX, [WIDE_ONE], [START], num_trials)


def test_the_density_is_the_prior_s_times_the_jacobian():
    c = coordinates()
    u = c.sample(50, seed=3)
    z = torch.from_numpy(c.to_z(u))
    expected = -np.log(2.0) + LogNormal(0.0, 2.0).log_prob(z[:, 1])
    expected = expected + Independent(Normal(torch.zeros(6), 1.0), 1).log_prob(z[:, 2:])
    # dz / du is b, and b z where z is searched in logs.
    expected = expected + np.log(c.scale).sum() + z[:, 1].log()
    assert c.log_prob(u) == pytest.approx(expected.numpy(), abs=1e-5)


def test_bounds_stay_bounds_and_count_as_within():
    c = coordinates()
    assert c.low[1:] == pytest.approx(-np.inf)
    u = np.zeros((4, c.dim))
    u[:, 0] = [c.low[0], c.high[0], c.low[0] - 1e-6, c.high[0] + 1e-6]
    assert np.isfinite(c.log_prob(u)).tolist()[2:] == [False, False]
    assert c.to_z(u)[:2, 0] == pytest.approx([1.0, 3.0])
    assert c.from_z(c.to_z(u)) == pytest.approx(u)


def test_a_coordinate_is_at_the_bound_where_its_draws_pile_up():
    c, rng = coordinates(), np.random.default_rng(0)
    for z, side in (
        (1.0 + 0.02 * rng.random((200, 1)), -1),
        (3.0 - 0.02 * rng.random((200, 1)), 1),
        (2.0 + 0.02 * rng.normal(size=(200, 1)), 0),
        (1.01 + 1e-3 * rng.normal(size=(200, 1)), 0),  # ten deviations from it
        (1.0 + 2.0 * rng.random((200, 1)), 0),  # the trials leave it open
    ):
        whole = np.concatenate([z, np.ones((200, c.dim - 1))], 1)
        assert c.sides(c.from_z(whole)[:, :1]).tolist() == [side]
        # Beside it are numbers without a bound, or with one.
        assert c.sides(c.from_z(whole))[1:].tolist() == [0] * (c.dim - 1)


# Coordinates carried from one rival to another mean the same there


FRICTION = effect("friction", prior=half(45.0))
OTHERS = [effect(f"other {k}") for k in range(3)]


def test_an_effect_and_a_nuisance_have_the_same_units_in_every_rival():
    prior = BoxUniform(torch.zeros(2), torch.tensor([1.0, 3.0]))
    alone = SearchCoordinates(prior, [FRICTION], [], 5)
    null = alone.from_z(np.array([[0.5, 1.0, 0.0]]))[0]
    for place, effects in ((5, [*OTHERS, FRICTION]), (2, [FRICTION, *OTHERS])):
        other = SearchCoordinates(prior, effects, [], 5)
        u = other.from_z(np.zeros((1, 6)))
        assert u[0, place] == other.low[place] == alone.low[2] == null[2]
        u[0, :2] = null[:2]
        np.testing.assert_allclose(other.to_z(u)[0, :2], [0.5, 1.0])
    offset = effect("offset", prior=normal(3.0))
    alone, beside = (SearchCoordinates(prior, e, [offset], 4) for e in ([], [FRICTION]))
    np.testing.assert_array_equal(alone.shift[2:], beside.shift[3:])
    np.testing.assert_array_equal(alone.scale[2:], beside.scale[3:])
