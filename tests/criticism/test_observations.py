"""Evidence and observations of any kind, against closed forms where there is one."""

import math

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform
from scipy.special import logsumexp
from scipy.stats import norm
from torch.distributions import Independent, MultivariateNormal, Normal

from sbi_active import DiscreteActions, SimulatorModel
from sbi_active.criticism import AugmentedSimulator, Criticism, Trials
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.fit import THOROUGH, settings_of
from sbi_active.criticism.rivals.rival import DISAGREEMENT
from sbi_active.criticism.rivals.rival_set import RivalSet
from sbi_active.criticism.rivals.trial_simulator import NUM_REPLICATES, TrialSimulator
from sbi_active.criticism.steps.predictive import predict
from sbi_active.inference.engine import infer, search
from tests.effects import BIAS, effect, normal, with_error

PRIOR = Independent(Normal(torch.zeros(2), torch.tensor([2.0, 1.0])), 1)
NOISE = 0.5
ACTION = torch.linspace(-2, 2, 8)[:, None]
X = torch.tensor([0.3, 1.4, -0.2, 0.8, 2.2, 1.1, 3.5, 2.9])[:, None]


def line(theta, action):
    return theta[:, :1] + theta[:, 1:2] * action


def ending(theta, action):
    """A line that gives nothing beyond actions of 1."""
    return torch.where(action > 1, torch.nan, line(theta, action))


START = effect("start", prior=Normal(0.0, 0.8), scope="trial")


def rivals(fn, trials, effects=(), **keywords):
    model = SimulatorModel(fn, noise=NOISE)
    return RivalSet(model, PRIOR, trials, effects, **keywords)


def exact(action, x, extra=0.0):
    """Return log N(x; 0, B S B^T + (noise^2 + extra^2) I) of the line."""
    xi = action[:, 0].double()
    design = torch.stack([2 * xi**0, xi], 1)
    cov = design @ design.T + (NOISE**2 + extra**2) * torch.eye(len(xi))
    normal = MultivariateNormal(torch.zeros(len(xi)).double(), cov)
    return float(normal.log_prob(x.double()))


# What the engine of samples gives for a line


def test_scatter_sums_out_the_size_of_a_larger_error():
    found = rivals(line, Trials(ACTION, X)).fit(ModelKey(error="scatter")).evidence
    sizes = np.geomspace(0.3, 40.0, 1_000)
    each = [exact(ACTION, X[:, 0], extra=NOISE * s) for s in sizes]
    # Eleven sizes stand for all.
    error = 0.1 + 3 * found.standard_error
    expected = logsumexp(each, b=1 / len(each))
    assert found.log_evidence == pytest.approx(expected, abs=error)


def inferred(seed):
    rival = rivals(line, Trials(ACTION, X)).rival(ModelKey())
    rng = np.random.default_rng(seed)
    found = search(rival, rng, settings=THOROUGH)
    return infer(rival, rng, found=found, settings=settings_of(8, is_bare=False))


def test_the_standard_error_claims_what_repeated_runs_show():
    found = [inferred(seed) for seed in range(20)]
    gap = np.array([f.log_evidence for f in found]) - exact(ACTION, X[:, 0])
    claimed = np.mean([f.standard_error for f in found])
    assert 0.5 * claimed < np.sqrt((gap**2).mean()) < 1.7 * claimed


# Outcomes


FLAG = math.log(DISAGREEMENT / (1 - DISAGREEMENT))


def require_evidence(models, expected):
    found = models.fit().evidence
    assert found.standard_error < 0.2
    assert found.log_evidence == pytest.approx(expected, abs=4 * found.standard_error)


def test_a_trial_without_a_measurement_costs_its_flag():
    x = X.clone()
    x[2] = torch.nan
    keep = x[:, 0].isfinite()
    kept = exact(ACTION[keep], X[keep, 0])
    require_evidence(rivals(line, Trials(ACTION, x)), kept + FLAG)


def test_a_measurement_where_there_should_be_none_has_the_prior_predictive():
    models, keep = rivals(ending, Trials(ACTION, X)), ACTION[:, 0] <= 1
    lost = ~keep.numpy()
    center, spread = models.center[lost], models.spread[lost]
    expected = exact(ACTION[keep], X[keep, 0]) + lost.sum() * FLAG
    expected += norm.logpdf(X[~keep, 0].numpy(), center, spread).sum()
    require_evidence(models, expected)


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


def test_a_nuisance_of_each_trial_is_integrated_out_and_drawn_for_another():
    models = rivals(line, Trials(ACTION, X), [START])
    evidence = exact(ACTION, X[:, 0], extra=0.8)
    require_evidence(models, evidence)
    # Only draws in the tail of the nuisance reach the second: of 4,000, each of one of
    # some 170 effective particles, an error of .1 to .15.
    new = Trials([0.5, 1.5], [1.0, 5.0])
    density = predict(models, new, num_draws=4_000).log_density
    for k, own in enumerate(density):
        action = torch.cat([ACTION, new.action[k : k + 1].float()])
        both = exact(action, torch.cat([X[:, 0], new.x[k].float()]), extra=0.8)
        assert own == pytest.approx(both - evidence, abs=0.4)


# Trajectories


TIMES = [torch.tensor([0.0, 0.3, 0.7]), torch.tensor([0.1, 0.2, 0.4, 1.3])]


def grow(theta, action, times=None):
    stamps = torch.linspace(0, 2, 5).to(theta) if times is None else times.to(theta)
    return theta[:, :1] * action * torch.exp(theta[:, 1:2] * stamps)


def test_a_simulator_is_asked_for_the_times_of_each_trial():
    theta = torch.tensor([[1.5, -0.4], [0.7, 0.2]])
    action = torch.tensor([[1.0], [2.0]])
    rows = [grow(theta, a, t) for a, t in zip(action, TIMES, strict=True)]
    trials = Trials(action, [own[0] for own in rows], sample_times=TIMES)
    model = AugmentedSimulator(SimulatorModel(grow, noise=0.1), [])
    simulator = TrialSimulator(model, trials)
    mean, _, _ = simulator.predict(theta, {})
    np.testing.assert_allclose(mean, torch.cat(rows, 1), atol=1e-6)
    assert simulator.measurements.has_time


def test_actions_that_are_not_permitted_are_simulated_where_they_were():
    model = SimulatorModel(line, noise=NOISE)
    permitted = DiscreteActions(ACTION[1:-1])
    with pytest.warns(UserWarning, match=r"trial 0 .*\(trials 0, 7\).*SA202"):
        criticism = Criticism(model, PRIOR, Trials(ACTION, X), actions=permitted)
    mean, _, _ = criticism.rivals.simulator.predict(torch.tensor([[0.0, 1.0]]), {})
    np.testing.assert_allclose(mean[0], ACTION[:, 0], atol=1e-6)


# Many numbers a trial


PATTERN = torch.randn(3, 160, generator=torch.Generator().manual_seed(0))


def picture(theta, action):
    return theta[:, :1] * PATTERN[:1] + theta[:, 1:2] * action * PATTERN[1:2]


STAIN = effect(
    "stain",
    prior=Normal(0.0, 0.5),
    apply=lambda x, phi, action, context: x + phi * PATTERN[2:].to(x),
)


def test_a_stain_on_pictures_is_named_with_its_strength():
    x = picture(torch.tensor([[1.0, -0.5]]), ACTION) + 0.14 * PATTERN[2]
    x = with_error(x, NOISE, 1)
    model = SimulatorModel(picture, noise=NOISE)
    tracing = Criticism(model, PRIOR, Trials(ACTION, x), effects=[STAIN]).trace()
    assert tracing.verdict == "stain"
    phi, sd = tracing.evidences["stain"].moments["stain"]
    error = NOISE / (8 * 160) ** 0.5  # patterns are nearly orthogonal
    assert phi == pytest.approx(0.14, abs=4 * error)
    assert sd == pytest.approx(error, rel=0.2)


# A simulator that jumps: what its jumps count as, and evidence beside them


ERROR, JUMP = 0.1, 0.2
BOX = BoxUniform(-2 * torch.ones(2), 2 * torch.ones(2))
PLACES = torch.tensor([-2.0, -1.5, -1.0, -0.5, 0.5, 1.0, 1.5, 2.0])[:, None]
DRIFT = effect(
    "drift",
    hook="action",
    apply=lambda xi, phi, action, context: xi + phi * context.index[:, None],
)


def smooth(theta, action):
    return theta[:, :1] * action + theta[:, 1:] * action**2


def jumping(theta, action):
    phase = 1e6 * theta.sum(1, keepdim=True) * (action + 3.1)
    return smooth(theta, action) + JUMP * torch.sin(phase)


def stepping(theta, action):
    """Smooth between two steps, with the slopes of what has none."""
    phase = 37 * theta.sum(1, keepdim=True) * (action + 3.1)
    return smooth(theta, action) + JUMP * torch.sign(torch.sin(phase))


def bending(theta, action):
    """Smooth, though its slopes change within a coarse step of differences."""
    return smooth(theta, action) + 0.04 * torch.sin(150 * theta[:, :1]) * action


def rough(fn, sd=ERROR, seed=0):
    theta = torch.tensor([[0.7, -0.4]], dtype=torch.float64)
    gen = torch.Generator().manual_seed(3)
    noise = torch.randn(8, 1, generator=gen, dtype=torch.float64)
    x = fn(theta, PLACES.double()) + sd * noise
    model = SimulatorModel(fn, noise=sd)
    return RivalSet(model, BOX, Trials(PLACES, x), [BIAS], seed=seed)


@pytest.mark.parametrize(("fn", "sd"), [(smooth, ERROR), (bending, 0.001)])
def test_a_smooth_simulator_has_no_jumps(fn, sd):
    found = rough(fn, sd)
    assert found.is_smooth
    assert found.step < 1e-2
    assert not found.roughness.any()
    assert found.noise.cells[0].sd == pytest.approx(sd)


@pytest.mark.parametrize("seed", [0, 1])
def test_jumps_have_their_size_and_count_as_noise(seed):
    found = rough(jumping, seed=seed)
    assert not found.is_smooth
    # The median of |sin| over that of |normal|, by its error from 64 draws.
    size = JUMP * np.sqrt(0.5) / 0.6745
    assert np.median(found.roughness) == pytest.approx(size, rel=0.2)
    assert found.noise.cells[0].sd == pytest.approx(np.hypot(ERROR, found.roughness))
    steps = rough(stepping, seed=seed)  # whose slopes agree between them
    assert not steps.is_smooth
    assert float(np.median(steps.roughness)) > ERROR


def test_repeated_actions_are_simulated_once_and_predict_the_same():
    seen = []

    def counting(theta, action):
        seen.append(len(theta))
        return jumping(theta, action)

    action = PLACES[[0, 3, 3, 5, 0, 7]]
    model = SimulatorModel(counting, noise=ERROR)
    own = AugmentedSimulator(model, [BIAS, DRIFT])
    simulator = TrialSimulator(own, Trials(action, torch.zeros(6, 1)))
    theta = BOX.sample((5,)).double()
    bias = torch.linspace(-1, 1, 5, dtype=torch.float64)[:, None]
    simulator.predict(theta[:1], {})  # effects are held to their nulls before
    seen.clear()
    mean, _, _ = simulator.predict(theta, {"bias": bias})
    every = jumping(theta.repeat_interleave(6, 0), action.double().repeat(5, 1))
    assert np.array_equal(mean, (every.reshape(5, 6) + bias).numpy())
    # What depends on the trial's place is no repetition.
    simulator.predict(theta, {"drift": bias + 3.14159})
    assert seen == [5 * 4, 5 * 6]


def test_a_random_simulator_is_not_merged():
    def draw(theta, action):
        return smooth(theta, action) + torch.randn(len(theta), 1)

    model = AugmentedSimulator(SimulatorModel(draw), [BIAS])
    x = model.evaluate(torch.zeros(64, 2), {}, torch.ones(64, 1), merge=True)
    assert len(x.unique()) > 32


def test_jumps_far_from_the_fit_are_none_there():
    def curve(theta, action):
        rough = torch.round(20 * theta) / 20
        return torch.where(theta.abs() > 0.5, rough, theta) * action

    prior = normal(2.0)
    model = SimulatorModel(curve, noise=0.01)
    action = torch.linspace(1, 2, 8)[:, None]
    some = RivalSet(model, prior, Trials(action, 0.1 * action), [])
    assert some.is_smooth
    assert not some.roughness.any()
    assert some.step <= 1e-3
    # The same where the fit is among the jumps.
    other = RivalSet(model, prior, Trials(action, 1.523 * action), [])
    assert not other.is_smooth
