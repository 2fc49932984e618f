"""Evidence under Student's t errors is that of a dense integral."""

import numpy as np
import pytest
import torch
from scipy.special import logsumexp
from scipy.stats import norm, t
from torch.distributions import Independent, Uniform

from sbi_active import SimulatorModel, StudentTNoise
from sbi_active.criticism import Criticism, Trials
from sbi_active.criticism.linear.screening import linear_models
from sbi_active.criticism.misfit.verdict import judge
from sbi_active.criticism.results import SCATTER, UNEXPLAINED, ModelKey
from sbi_active.criticism.rivals.heavy_tails import (
    deviance_slope,
    from_deviance,
    signed_deviance,
    student,
    tangent,
)
from sbi_active.criticism.rivals.rival_set import RivalSet
from sbi_active.criticism.steps.detection import credible_set
from tests.criticism.linear.test_any_simulator import (
    ACTION,
    BARE,
    BIAS,
    EFFECTS,
    PRIOR,
    SD,
    XI,
    curve,
    measured,
    shifted,
)
from tests.criticism.misfit import oscillator

DF = 3.0


def verdict_of(x, action=ACTION):
    model = SimulatorModel(curve, noise=StudentTNoise(SD, DF))
    some = RivalSet(model, PRIOR, Trials(action, x), EFFECTS[:1], seed=0)
    return judge(linear_models(some)[0])


def dense(x, sds, size=1.0):
    """Log evidence of a line, a square and a bias by sums over finer and finer grids.

    In sensor deviations, with normal priors of these deviations.
    """
    design = np.stack([XI, XI**2, XI**0], 1)[:, : len(sds)]
    scale = size * np.sqrt((DF - 2) / DF)
    low, high = -6.0 * np.ones(len(sds)), 6.0 * np.ones(len(sds))
    for _ in range(7):
        axes = [np.linspace(*ends, 31) for ends in zip(low, high, strict=True)]
        u = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(sds))
        error = (x[:, 0].numpy() - u @ design.T) / SD
        log_p = t.logpdf(error, DF, scale=scale).sum(1) + norm.logpdf(u, 0, sds).sum(1)
        cell = np.array([axis[1] - axis[0] for axis in axes])
        near = u[log_p > log_p.max() - 16]
        low, high = near.min(0) - cell, near.max(0) + cell
    return logsumexp(log_p) + np.log(cell).sum()


def gained(x):
    bare = dense(x, [1.0, 1.0])
    each = [dense(x, [1.0, 1.0, width]) for width in (1 / 3, 1.0, 3.0)]
    return logsumexp(each) - np.log(3) - bare


@pytest.mark.parametrize("far", [0.0, 3.0, 10.0, 30.0])
@pytest.mark.parametrize("place", [4, 10])
def test_the_evidence_of_an_effect_is_that_of_the_dense_integral(far, place):
    """However far one trial is off, and however much the bare model hangs on it."""
    x = measured(bias=1.0, seed=1)
    x[place] += far * SD
    states = verdict_of(x).states
    linear = states.log_evidence(BIAS) - states.log_evidence(BARE)
    # The bare model has several peaks, of which the highest is integrated.
    assert linear == pytest.approx(gained(x), abs=1.6)


def test_a_strong_effect_is_not_overstated_where_least_squares_ends_elsewhere():
    """A fit by least squares says 71 nats here: it ends where no peak is."""
    x = measured(bias=4.0, seed=1)
    x[10] += 10 * SD
    states = verdict_of(x).states
    linear = states.log_evidence(BIAS) - states.log_evidence(BARE)
    assert linear == pytest.approx(gained(x), abs=1.5)


@pytest.mark.parametrize("wider", [1.0, 10.0, 300.0])
def test_larger_errors_have_tails_as_heavy(wider):
    error = t(DF, scale=np.sqrt((DF - 2) / DF)).rvs(12, random_state=0)
    theta = torch.tensor([[0.7, -0.4]]).double()
    x = curve(theta, ACTION) + wider * SD * torch.tensor(error)[:, None]
    found = verdict_of(x)
    sizes = np.hypot(1, found.search.errors.sizes)
    each = [dense(x, [1.0, 1.0], size) for size in sizes]
    expected = logsumexp(each) - np.log(len(each))
    scatter = found.states.log_evidence(ModelKey(error=SCATTER))
    assert scatter == pytest.approx(expected, abs=0.6)


def test_what_is_undeclared_beside_heavy_tails_is_no_scatter():
    action = torch.linspace(-2, 2, 30, dtype=torch.float64)[:, None]
    error = t(DF, scale=np.sqrt((DF - 2) / DF)).rvs(30, random_state=3)
    theta = torch.tensor([[0.7, -0.4]]).double()
    x = curve(theta, action) + 3 * (3 * action).sin()
    x += SD * torch.tensor(error)[:, None]
    x[12] += 30 * SD
    found = verdict_of(x, action)
    assert found.key == ModelKey(error=UNEXPLAINED)
    joint = found.states.joint(BARE)
    assert joint[found.key] > joint[ModelKey(error=SCATTER)] + 10


def test_gaussians_touch_the_density_from_below():
    errors = np.linspace(-9, 9, 101)
    for at in (0.0, 0.7, 6.0):
        weight, peak = tangent(np.array(at), DF)
        below = peak - 0.5 * (weight * errors) ** 2
        assert (below <= student(errors, DF) + 1e-12).all()
        assert peak - 0.5 * (weight * at) ** 2 == pytest.approx(
            student(np.array(at), DF)
        )


def test_squares_of_signed_deviances_are_what_log_densities_lose():
    errors = np.array([-1e8, -3.0, 0.0, 1e-6, 2.0])
    found = signed_deviance(errors, DF)
    lost = student(np.zeros(5), DF) - student(errors, DF)
    assert 0.5 * found**2 == pytest.approx(lost)
    assert from_deviance(found, DF) == pytest.approx(errors)
    slope = (signed_deviance(errors + 1e-4, DF) - found)[1:] / 1e-4
    assert deviance_slope(errors, DF)[1:] == pytest.approx(slope, rel=1e-3)


@pytest.mark.parametrize("far", [0.0, 30.0])
def test_a_narrow_prior_is_seen_beside_a_trial_far_off(far):
    narrow = torch.tensor([0.5, 2.0]).double()
    slope = shifted("slope", torch.sin)
    x = measured(seed=2)
    x[4] += far * SD
    model = SimulatorModel(curve, noise=StudentTNoise(SD, DF))
    prior = Independent(Uniform(-narrow, narrow), 1)
    loop = Criticism(model, prior, Trials(ACTION, x), effects=[slope, *EFFECTS[1:]])
    assert loop.trace().verdict == "slope"
    bounds = loop.judged(None).bounds
    assert bounds is not None
    assert bounds.replaces == "slope"
    assert bounds.parameters[0].beyond == pytest.approx(0.7, abs=0.15)


def test_a_trial_in_other_units_is_an_outlier_beside_heavy_tails():
    own = oscillator.trials()
    own.x[5] /= 100  # metres for centimetres
    noise = StudentTNoise(oscillator.SENSOR, 4.0)
    model = SimulatorModel(
        oscillator.oscillate, noise=noise, batched=True, sample_times=oscillator.TIMES
    )
    found = Criticism(model, oscillator.PRIOR, own).trace()
    assert found.verdict == "outlier"
    assert credible_set(found.outliers) == (5.0,)
