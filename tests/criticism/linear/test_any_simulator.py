"""Linear models of simulators that are random, jump, fail, or have heavy tails."""

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal
from torch.distributions import Independent, Normal, Uniform

from sbi_active import GaussianNoise, SimulatorModel, StudentTNoise
from sbi_active.criticism import Criticism, Trials
from sbi_active.criticism.linear.screening import linear_models
from sbi_active.criticism.misfit.verdict import judge
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.rival_set import RivalSet
from tests.effects import on_outcomes

SD = 0.3
ACTION = torch.linspace(-2, 2, 12, dtype=torch.float64)[:, None]
XI = ACTION[:, 0].numpy()
PRIOR = Independent(Normal(torch.zeros(2), torch.ones(2)), 1)
BARE, BIAS = ModelKey(), ModelKey(("bias",))


def shifted(name, shape):
    return on_outcomes(name, lambda x, phi, action, context: x + phi * shape(action))


EFFECTS = [shifted("bias", torch.ones_like), shifted("wave", lambda xi: (3 * xi).sin())]


def curve(theta, action):
    return theta[:, :1] * action + theta[:, 1:2] * action**2


def measured(bias=0.0, seed=0):
    noise = torch.randn(12, 1, generator=torch.Generator().manual_seed(seed))
    theta = torch.tensor([[0.7, -0.4]]).double()
    return curve(theta, ACTION) + bias + SD * noise.double()


def verdict_of(model, x):
    some = RivalSet(model, PRIOR, Trials(ACTION, x), EFFECTS, seed=0)
    return judge(linear_models(some)[0])


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
    gain = np.diff([found.states.log_evidence(key) for key in (BARE, BIAS)])
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
    theta = torch.tensor([[0.7, -0.4]]).double()
    x = curve(theta, action) + 2.5 * SD * noise
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


@pytest.mark.parametrize("bias", [0.0, 1.0])
def test_heavy_tails_have_the_bayes_factor_of_importance_sampling(bias):
    x = measured(bias)
    x[4] += 3.0
    model = SimulatorModel(curve, noise=StudentTNoise(SD, 3.0))
    found = verdict_of(model, x)
    linear = np.diff([found.states.log_evidence(key) for key in (BARE, BIAS)])
    some = RivalSet(model, PRIOR, Trials(ACTION, x), EFFECTS, seed=0)
    sampled = np.diff([some.fit(key).evidence.log_evidence for key in (BARE, BIAS)])
    # Three widths of the effect's prior, of which one was declared.
    assert linear == pytest.approx(sampled, abs=1.5, rel=0.15)
    weight = 1 / found.search.model(BIAS).scale
    assert weight.argmin() == 4


def test_which_trials_have_an_outcome_tells_of_parameters_and_effects():
    """A response that ends at a height; where it should not, none has one."""

    def ends(theta, action):
        x = curve(theta, action)
        return torch.where(x > 1.0, torch.nan, x)

    model = SimulatorModel(ends, noise=GaussianNoise(SD))
    x = measured(seed=2)
    x[curve(torch.tensor([[0.7, -0.4]]).double(), ACTION) > 1.0] = torch.nan
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
        lambda theta, xi: torch.round(curve(theta, xi) / 0.4) * 0.4,
        noise=GaussianNoise(0.05),
    )
    x = torch.round((measured() + 1.5 * (3 * ACTION).sin()) / 0.4) * 0.4
    loop = Criticism(model, PRIOR, Trials(ACTION, x), effects=EFFECTS)
    assert not loop.rivals.is_smooth
    assert loop.trace().verdict == "wave"
    assert loop.rivals.simulator.num_simulations < 50_000 * 12
