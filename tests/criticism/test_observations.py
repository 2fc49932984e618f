"""Observations of any kind, against closed forms where there is one."""

import math

import numpy as np
import pytest
import torch
from scipy.stats import norm
from torch.distributions import HalfNormal, Independent, MultivariateNormal, Normal

from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.criticism import AugmentedSimulator, Criticism, Trials, close_loop
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.rivals.trial_simulator import NUM_REPLICATES, TrialSimulator
from sbi_active.criticism.rivals.validity import (
    DISAGREEMENT,
    UNKNOWN_RATES,
    log_outcomes,
)
from sbi_active.criticism.steps.predictive import predict
from tests.effects import effect

PRIOR = Independent(Normal(torch.zeros(2), torch.tensor([2.0, 1.0])), 1)
NOISE = 0.5
ACTION = torch.linspace(-2, 2, 8)[:, None]
X = torch.tensor([0.3, 1.4, -0.2, 0.8, 2.2, 1.1, 3.5, 2.9])[:, None]


def line(theta, action):
    return theta[:, :1] + theta[:, 1:2] * action


def ending(theta, action, reach=0.0):
    """A line that gives nothing beyond actions of 1."""
    reach = torch.as_tensor(reach).reshape(-1, 1)
    return torch.where(action > 1 + reach, torch.nan, line(theta, action))


REACH = effect(
    "reach",
    hook="dynamics",
    prior=Independent(HalfNormal(torch.ones(1)), 1),
    apply=lambda value, phi, action, context: {**value, "reach": phi[:, 0]},
)


START = effect("start", prior=Normal(0.0, 0.8), scope="trial")


def rivals(fn, trials, effects=(), **keywords):
    model = SimulatorModel(fn, noise=GaussianNoise(NOISE))
    return RivalSet(model, PRIOR, trials, effects, **keywords)


def exact(action, x, extra=0.0):
    """Return log N(x; 0, B S B^T + (noise^2 + extra^2) I) of the line."""
    xi = action[:, 0].double()
    design = torch.stack([2 * xi**0, xi], 1)
    cov = design @ design.T + (NOISE**2 + extra**2) * torch.eye(len(xi))
    normal = MultivariateNormal(torch.zeros(len(xi)).double(), cov)
    return float(normal.log_prob(x.double()))


# Outcomes


def test_a_trial_without_a_measurement_costs_its_flag():
    x = X.clone()
    x[2] = torch.nan
    found = rivals(line, Trials(ACTION, x)).fit().evidence
    keep = x[:, 0].isfinite()
    expected = exact(ACTION[keep], X[keep, 0])
    expected += math.log(DISAGREEMENT / (1 - DISAGREEMENT))
    assert found.log_evidence == pytest.approx(expected, abs=4 * found.standard_error)


def test_a_measurement_where_there_should_be_none_has_the_prior_predictive():
    trials = Trials(ACTION, X)
    models = rivals(ending, trials)
    found = models.fit().evidence
    keep = ACTION[:, 0] <= 1
    lost = ~keep.numpy()
    expected = exact(ACTION[keep], X[keep, 0])
    center, spread = models.center[lost], models.spread[lost]
    expected += norm.logpdf(X[~keep, 0].numpy(), center, spread).sum()
    expected += lost.sum() * math.log(DISAGREEMENT / (1 - DISAGREEMENT))
    assert found.log_evidence == pytest.approx(expected, abs=4 * found.standard_error)


@pytest.mark.slow
def test_flags_alone_point_to_an_effect():
    x = line(torch.tensor([[1.0, -0.5]]), ACTION)
    x = x + NOISE * torch.randn(x.shape, generator=torch.Generator().manual_seed(0))
    model = SimulatorModel(ending, noise=GaussianNoise(NOISE))
    action, x = ACTION.repeat(2, 1), torch.cat([x, x.flip(1) + 0.1])
    bias = effect("bias")
    tracing = Criticism(model, PRIOR, Trials(action, x), effects=[REACH, bias]).trace()
    assert tracing.verdict == "reach"


@pytest.mark.slow
def test_flags_that_nothing_explains_are_unexplained_and_named():
    x = X.clone()
    x[[0, 2, 3, 5]] = torch.nan
    model = SimulatorModel(line, noise=GaussianNoise(NOISE))
    action, x = ACTION.repeat(2, 1), torch.cat([x, x + 0.1])
    report = close_loop(
        model,
        PRIOR,
        Trials(action, x),
        effects=[effect("bias")],
        evaluate=False,
        plan=False,
    )
    assert report.verdict == "unexplained"
    assert (report.residuals.probability_valid == 1).all()
    assert any("trials 0, 2, 3, 5, 8" in w for w in report.warnings)


def test_a_random_simulator_gives_its_own_probability_of_an_outcome():
    def draw(theta, action):
        x = line(theta, action) + torch.randn(len(theta), 1)
        return torch.where(torch.rand(len(theta), 1) < 0.7, x, torch.nan)

    model = AugmentedSimulator(SimulatorModel(draw), [])
    simulator = TrialSimulator(model, Trials(ACTION, X))
    theta = torch.tensor([[1.0, 0.5]]).repeat(20, 1)
    mean, sd, probability = simulator.predict(theta, {})
    num = 8 * NUM_REPLICATES  # the same seeds for every parameter, or not: at least
    error = math.sqrt(0.7 * 0.3 / num)
    assert probability.mean() == pytest.approx(0.7, abs=4 * error)
    assert sd is not None
    assert np.isfinite(mean).all()
    # Of a mean over 8 trials of some 22 draws of unit deviation each.
    middle = (mean - line(theta[:1], ACTION).numpy()[:, 0]).mean()
    assert abs(middle) < 4 / math.sqrt(0.7 * num)


# Nuisances of each trial


def test_masked_numbers_are_left_out():
    def two(theta, action):
        return line(theta, action).repeat(1, 2)

    x = torch.cat([X, torch.full_like(X, torch.nan)], 1)
    x[3] = x[3].flip(0)
    found = rivals(two, Trials(ACTION, x)).fit().evidence
    expected = exact(ACTION, X[:, 0])
    assert found.log_evidence == pytest.approx(expected, abs=4 * found.standard_error)


def test_a_nuisance_of_each_trial_is_integrated_out():
    found = rivals(line, Trials(ACTION, X), [START]).fit().evidence
    expected = exact(ACTION, X[:, 0], extra=0.8)
    assert found.standard_error < 0.2
    assert found.log_evidence == pytest.approx(expected, abs=4 * found.standard_error)


def test_an_unseen_trial_draws_its_own_nuisance():
    trials, new = Trials(ACTION, X), Trials([0.5, 1.5], [1.0, 5.0])
    # Only draws in the tail of the nuisance reach the second: of 4,000, each of one of
    # some 170 effective particles, an error of .1 to .15.
    sample = rivals(line, trials, [START])
    density = predict(sample, new, num_draws=4_000).log_density
    every = [torch.cat([ACTION, a[None]]) for a in new.action.float()]
    expected = [
        exact(a, torch.cat([X[:, 0], y.float()]), extra=0.8)
        - exact(ACTION, X[:, 0], extra=0.8)
        for a, y in zip(every, new.x, strict=True)
    ]
    np.testing.assert_allclose(density, expected, atol=0.4)


# Trajectories


TIMES = [torch.tensor([0.0, 0.3, 0.7]), torch.tensor([0.1, 0.2, 0.4, 1.3])]


def grow(theta, action, times=None):
    stamps = torch.linspace(0, 2, 5).to(theta) if times is None else times.to(theta)
    return theta[:, :1] * action * torch.exp(theta[:, 1:2] * stamps)


def test_a_simulator_is_asked_for_the_times_of_each_trial():
    theta = torch.tensor([[1.5, -0.4], [0.7, 0.2]])
    action = torch.tensor([[1.0], [2.0]])
    rows = [grow(theta[:1], action[i : i + 1], t)[0] for i, t in enumerate(TIMES)]
    trials = Trials(action, rows, sample_times=TIMES)
    model = AugmentedSimulator(SimulatorModel(grow, noise=GaussianNoise(0.1)), [])
    simulator = TrialSimulator(model, trials)
    mean, _, _ = simulator.predict(theta, {})
    assert mean.shape == (2, 7)
    np.testing.assert_allclose(mean[0], torch.cat(rows), atol=1e-6)
    other = [grow(theta[1:], action[i : i + 1], t)[0] for i, t in enumerate(TIMES)]
    np.testing.assert_allclose(mean[1], torch.cat(other), atol=1e-6)
    assert simulator.measurements.has_time


@pytest.mark.slow
def test_ragged_and_masked_trajectories_go_through_the_whole_loop():
    gen = torch.Generator().manual_seed(0)
    action = torch.tensor([1.0, -1.0, 2.0, -2.0, 1.5, -0.5])
    rows, times = [], []
    for i, a in enumerate(action):
        t = torch.sort(2 * torch.rand(8 + 2 * i, generator=gen)).values
        x = 0.8 * a * torch.exp(-0.6 * t) + 0.3
        rows.append(x + 0.05 * torch.randn(len(t), generator=gen))
        rows[i][2] = torch.nan
        times.append(t)
    rows[4][:] = torch.nan
    report = close_loop(
        SimulatorModel(grow, noise=GaussianNoise(0.05)),
        PRIOR,
        Trials(action, rows, sample_times=times),
        effects=[effect("bias"), effect("gain", apply=lambda x, p, a, c: x * (1 + p))],
        actions=DiscreteActions(torch.linspace(-2, 2, 9)),
    )
    assert report.verdict == "bias"
    rmse = report.before_after.set_index("metric").loc["rmse"]
    assert rmse["ratio"] < 0.5
    assert any("trial 4 gave no measurement" in w for w in report.warnings)
    assert report.simulator(report.prior.sample((3,)), torch.ones(3, 1)).shape == (3, 5)


def test_times_beyond_those_of_the_simulator():
    times = torch.linspace(0, 1, 5)
    model = SimulatorModel(
        lambda theta, action: theta[:, :1] * times.to(theta),
        noise=GaussianNoise(0.1),
        sample_times=times,
    )
    trials = Trials([1.0, 2.0], torch.ones(2, 3), sample_times=[0.0, 0.5, 1.5])
    with pytest.raises(ValueError, match="times within those of the simulator, 0 to 1"):
        Criticism(model, PRIOR, trials)


def test_actions_that_are_not_permitted_are_simulated_where_they_were():
    model = SimulatorModel(line, noise=GaussianNoise(NOISE))
    trials = Trials(ACTION, X)
    said = r"\[-2.0\] of trial 0 is not in .*\(trials 0, 7\)"
    with pytest.warns(UserWarning, match=said):
        criticism = Criticism(
            model, PRIOR, trials, actions=DiscreteActions(ACTION[1:-1])
        )
    mean, _, _ = criticism.rivals.simulator.predict(torch.tensor([[0.0, 1.0]]), {})
    np.testing.assert_allclose(mean[0], ACTION[:, 0], atol=1e-6)


# Many numbers a trial


PATTERN = torch.randn(3, 600, generator=torch.Generator().manual_seed(0))


def picture(theta, action):
    return theta[:, :1] * PATTERN[:1] + theta[:, 1:2] * action * PATTERN[1:2]


STAIN = effect(
    "stain",
    prior=Normal(0.0, 0.5),
    apply=lambda x, phi, action, context: x + phi * PATTERN[2:].to(x),
)


def test_a_stain_on_pictures_is_named_with_its_strength():
    gen = torch.Generator().manual_seed(1)
    x = picture(torch.tensor([[1.0, -0.5]]), ACTION) + 0.1 * PATTERN[2]
    x = x + NOISE * torch.randn(8, 600, generator=gen)
    model = SimulatorModel(picture, noise=GaussianNoise(NOISE))
    tracing = Criticism(model, PRIOR, Trials(ACTION, x), effects=[STAIN]).trace()
    assert tracing.verdict == "stain"
    (estimate,) = tracing.estimates
    error = NOISE / (8 * 600) ** 0.5  # patterns are nearly orthogonal
    assert estimate.mean == pytest.approx([0.1], abs=4 * error)
    assert estimate.sd == pytest.approx([error], rel=0.2)


# Random simulators without declared noise


def test_flags_have_the_probability_of_the_rates():
    p = np.array([[1.0, 1.0, 0.0], [1.0, 0.5, 0.25]])
    valid = np.array([True, False, False])
    e = DISAGREEMENT
    got = np.exp(log_outcomes(p, valid)) * (1 - e) ** 3
    assert got[0] == pytest.approx((1 - e) * e * (1 - e))
    assert got[1] == pytest.approx((1 - e) * 0.5 * (0.75 * (1 - e) + 0.25 * e))
    assert log_outcomes(p[:1], p[0] == 1)[0] == pytest.approx(0.0)
    each = [np.exp(log_outcomes(p, valid, (rate,))) for rate in UNKNOWN_RATES]
    np.testing.assert_allclose(
        np.exp(log_outcomes(p, valid, UNKNOWN_RATES)), np.mean(each, 0)
    )
