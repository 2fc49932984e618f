"""Linear models of simulators that are random, jump, fail, or have heavy tails."""

import numpy as np
import pytest
import torch
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm, t
from torch.distributions import Independent, Normal, Uniform

from sbi_active import SimulatorModel, StudentTNoise
from sbi_active.criticism import Criticism, Trials
from sbi_active.criticism.linear.screening import linear_models
from sbi_active.criticism.misfit.verdict import judge
from sbi_active.criticism.results import SCATTER, UNEXPLAINED, ModelKey
from sbi_active.criticism.rivals.rival_set import RivalSet
from sbi_active.criticism.steps.detection import credible_set
from tests.criticism.misfit import oscillator
from tests.effects import added

SD = 0.3
ACTION = torch.linspace(-2, 2, 12, dtype=torch.float64)[:, None]
XI = ACTION[:, 0].numpy()
PRIOR = Independent(Normal(torch.zeros(2), torch.ones(2)), 1)
BARE, BIAS = ModelKey(), ModelKey(("bias",))


TRUTH = torch.tensor([[0.7, -0.4]]).double()
EFFECTS = [added("bias", torch.ones_like), added("wave", lambda xi: (3 * xi).sin())]


def curve(theta, action):
    return theta[:, :1] * action + theta[:, 1:2] * action**2


def measured(bias=0.0, seed=0):
    noise = torch.randn(12, 1, generator=torch.Generator().manual_seed(seed))
    return curve(TRUTH, ACTION) + bias + SD * noise.double()


def verdict_of(model, x, effects=EFFECTS, action=ACTION):
    some = RivalSet(model, PRIOR, Trials(action, x), effects, seed=0)
    return judge(linear_models(some)[0])


def gain_of(log_evidence):
    """Return what the bias gains in log evidence."""
    return log_evidence(BIAS) - log_evidence(BARE)


def exact(x, *columns):
    design = np.stack([XI, XI**2, *columns], 1)
    cov = design @ design.T + SD**2 * np.eye(12)
    return multivariate_normal(np.zeros(12), cov).logpdf(x[:, 0].numpy())


@pytest.mark.parametrize("bias", [0.0, 0.8])
def test_a_random_simulator_has_the_evidence_of_its_own_deviation(bias):
    def draw(theta, action):
        return curve(theta, action) + SD * torch.randn(len(theta), 1).double()

    x = measured(bias)
    found = verdict_of(SimulatorModel(draw), x)
    gain = gain_of(found.states.log_evidence)
    widths = [exact(x, w * XI**0) for w in (1 / 3, 1.0, 3.0)]
    expected = np.logaddexp.reduce(widths) - np.log(3) - exact(x)
    # Of 32 draws a deviation has an error of an eighth, and a residual as well.
    assert gain == pytest.approx(expected, abs=1.0, rel=0.3)
    assert found.detection.alarm == (bias > 0)


def test_a_deviation_that_is_a_parameter_is_found():
    """Where only the size of the scatter is unknown, it is what the trials show."""

    def draw(theta, action):
        size = SD * torch.exp(theta[:, 2:])
        return curve(theta, action) + size * torch.randn(len(theta), 1).double()

    prior = Independent(Uniform(-2 * torch.ones(3), 2 * torch.ones(3)), 1)
    action = ACTION.repeat(4, 1)
    noise = torch.randn(48, 1, generator=torch.Generator().manual_seed(1)).double()
    x = curve(TRUTH, action) + 2.5 * SD * noise
    some = RivalSet(SimulatorModel(draw), prior, Trials(action, x), [], seed=0)
    found = judge(linear_models(some)[0])
    assert not found.detection.alarm
    mixture = found.states.mixture(BARE)
    z = some.rival(BARE).coordinates.to_z(mixture.mean[None])[0]
    # The log of a deviation from n numbers has an error of one in sqrt(2 n), a tenth.
    assert z[2] == pytest.approx(np.log(2.5), abs=0.4)
    scale = found.search.model(BARE).scale
    unit = found.search.unit
    assert np.median(unit * scale) == pytest.approx(2.5 * SD, rel=0.35)


def test_which_trials_have_an_outcome_tells_of_parameters_and_effects():
    """A response that ends at a height; where it should not, none has one."""

    def ends(theta, action):
        x = curve(theta, action)
        return torch.where(x > 1.0, torch.nan, x)

    model = SimulatorModel(ends, noise=SD)
    x = measured(seed=2)
    x[curve(TRUTH, ACTION) > 1.0] = torch.nan
    right = verdict_of(model, x)
    assert not right.detection.alarm
    lost = x.clone()
    lost[[5, 6, 7]] = torch.nan  # about zero, where no parameters end it
    missed = verdict_of(model, lost)
    every = np.ones(missed.search.errors.num_folds, bool)
    flags = missed.states._beside_numbers(missed.search.found[BARE], None, every)
    # Three trials that have no outcome in one case in fifty.
    assert flags == pytest.approx(3 * np.log(0.02 / 0.98), abs=0.5)


def test_jumps_count_as_noise_and_an_effect_beside_them_is_named():
    model = SimulatorModel(
        lambda theta, xi: torch.round(curve(theta, xi) / 0.4) * 0.4, noise=0.05
    )
    x = torch.round((measured() + 1.5 * (3 * ACTION).sin()) / 0.4) * 0.4
    loop = Criticism(model, PRIOR, Trials(ACTION, x), effects=EFFECTS)
    assert not loop.rivals.is_smooth
    assert loop.trace().verdict == "wave"
    assert loop.rivals.simulator.num_simulations < 50_000 * 12


# Evidence under Student's t errors is that of a dense integral


DF = 3.0


HEAVY = SimulatorModel(curve, noise=StudentTNoise(SD, DF))


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
    linear = gain_of(verdict_of(HEAVY, x, EFFECTS[:1]).states.log_evidence)
    # The bare model has several peaks, of which the highest is integrated.
    assert linear == pytest.approx(gained(x), abs=1.6)


def test_a_strong_effect_is_not_overstated_where_least_squares_ends_elsewhere():
    """A fit by least squares says 71 nats here: it ends where no peak is."""
    x = measured(bias=4.0, seed=1)
    x[10] += 10 * SD
    linear = gain_of(verdict_of(HEAVY, x, EFFECTS[:1]).states.log_evidence)
    assert linear == pytest.approx(gained(x), abs=1.5)


@pytest.mark.parametrize("wider", [1.0, 10.0, 300.0])
def test_larger_errors_have_tails_as_heavy(wider):
    error = t(DF, scale=np.sqrt((DF - 2) / DF)).rvs(12, random_state=0)
    x = curve(TRUTH, ACTION) + wider * SD * torch.tensor(error)[:, None]
    found = verdict_of(HEAVY, x, EFFECTS[:1])
    sizes = np.hypot(1, found.search.errors.sizes)
    each = [dense(x, [1.0, 1.0], size) for size in sizes]
    expected = logsumexp(each) - np.log(len(each))
    scatter = found.states.log_evidence(ModelKey(error=SCATTER))
    assert scatter == pytest.approx(expected, abs=0.6)


def test_what_is_undeclared_beside_heavy_tails_is_no_scatter():
    action = torch.linspace(-2, 2, 30, dtype=torch.float64)[:, None]
    error = t(DF, scale=np.sqrt((DF - 2) / DF)).rvs(30, random_state=3)
    x = curve(TRUTH, action) + 3 * (3 * action).sin()
    x += SD * torch.tensor(error)[:, None]
    x[12] += 30 * SD
    found = verdict_of(HEAVY, x, EFFECTS[:1], action)
    assert found.key == ModelKey(error=UNEXPLAINED)
    joint = found.states.joint(BARE)
    assert joint[found.key] > joint[ModelKey(error=SCATTER)] + 10


@pytest.mark.parametrize("far", [0.0, 30.0])
def test_a_narrow_prior_is_seen_beside_a_trial_far_off(far):
    narrow = torch.tensor([0.5, 2.0]).double()
    slope = added("slope", torch.sin)
    x = measured(seed=2)
    x[4] += far * SD
    prior = Independent(Uniform(-narrow, narrow), 1)
    loop = Criticism(HEAVY, prior, Trials(ACTION, x), effects=[slope, *EFFECTS[1:]])
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
        oscillator.oscillate, noise=noise, sample_times=oscillator.TIMES
    )
    found = Criticism(model, oscillator.PRIOR, own).trace()
    assert found.verdict == "outlier"
    assert credible_set(found.outliers) == (5.0,)
