"""A trial with a gross error is named and stands for no effect."""

import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import (
    BoxActions,
    DiscreteActions,
    GaussianNoise,
    SimulatorModel,
    StudentTNoise,
)
from sbi_active.criticism import Criticism, Effect, Trials, generic_effects
from sbi_active.criticism.steps.detection import credible_set
from tests.criticism.misfit import oscillator
from tests.effects import normal

PRIOR = BoxUniform(-5 * torch.ones(2), 5 * torch.ones(2))
ACTIONS = DiscreteActions(torch.arange(-5, 5.5, 0.5))
XI = torch.tensor([-2.5, 1.0, -0.5, 3.0, 4.5, -1.5, 2.0, 0.5])


def response(theta, action, quadratic=0.0):
    xi = action[:, 0]
    x = theta[:, 0] * torch.exp(3 - xi) + theta[:, 1] * xi + quadratic * xi**2
    return x[:, None]


MODEL = SimulatorModel(response, noise=1.0)
QUADRATIC = Effect.keyword("quadratic", prior=normal())


def measured(xi=XI, *, quadratic=0.0, seed=0):
    gen = torch.Generator().manual_seed(seed)
    theta = torch.tensor([[1.5, -2.0]]).expand(len(xi), -1)
    x = response(theta, xi[:, None], quadratic)
    return x + torch.randn(x.shape, generator=gen)


def criticism(x, *, xi=XI, model=MODEL, **options):
    trials = Trials(xi, x, **options)
    return Criticism(model, PRIOR, trials, effects=[QUADRATIC], actions=ACTIONS)


@pytest.mark.parametrize("size", [8.0, -20.0])
def test_a_gross_error_is_named_by_the_trial_s_own_index(size):
    x = measured()
    x[7] += size
    loop = criticism(x, index=torch.arange(8) + 11)
    found = loop.trace()
    assert found.verdict == "outlier"
    assert found.chosen == ()
    assert credible_set(found.outliers) == (18.0,)
    assert sum(found.probabilities.values()) == pytest.approx(1.0)
    made = loop.report(evaluate=False, plan=False)
    assert "trial 18" in str(made).splitlines()[0]
    assert "SA521" in [w.code for w in made.warnings]
    assert made.simulator is loop.model
    theta = made.parameters.set_index("parameter")["after"]
    assert abs(theta["theta_2"] + 2.0) < 0.6  # without the trial


@pytest.mark.parametrize(("num", "wrong"), [(4, 0), (8, 5)])
def test_a_slip_along_a_trajectory_is_an_outlier_and_no_process(num, wrong):
    own = oscillator.trials(action=oscillator.ACTION[:num])
    own.x[wrong] /= 100  # metres for centimetres
    loop = Criticism(oscillator.MODEL, oscillator.PRIOR, own)
    assert loop.trace().misfit is None
    assert loop.trace().verdict == "outlier"
    assert credible_set(loop.trace().outliers) == (float(wrong),)


T = torch.linspace(0.05, 2, 40)
BAD = {"sign": lambda x: -x, "gain": lambda x: 1.5 * x}


def decay(theta, action):
    return action * torch.exp(-theta[:, 1:] * T) * torch.cos(theta[:, :1] * T)


def sweep(theta, action):
    return theta[:, :1] * torch.sin(action * T * (1 + theta[:, 1:] * T))


@pytest.mark.parametrize(
    ("fn", "truth", "kind", "seed"),
    [(decay, [3.1, 0.4], "sign", 1), (sweep, [1.5, 0.25], "gain", 0)],
)
def test_a_trial_that_bends_the_fit_to_all_stands_for_no_effect(fn, truth, kind, seed):
    """Where the fit to all lies the simulator has another slope: a bias was named."""
    actions = BoxActions(0.3, 2.0)
    action = actions.sample((6,), seed=seed)
    model = SimulatorModel(fn, noise=GaussianNoise(0.02), sample_times=T)
    x = model(torch.tensor([truth]).expand(6, -1), action, seeds=torch.arange(6))
    wrong = int(action.argmax())
    x[wrong] = BAD[kind](x[wrong])
    prior = BoxUniform(torch.tensor([0.5, 0.0]), torch.tensor([6.0, 2.0]))
    effects = generic_effects(model, actions)
    given = model, prior, Trials(action, x)
    loop = Criticism(*given, effects=effects, actions=actions)
    found = loop.trace()
    assert found.verdict == "outlier"
    assert credible_set(found.outliers) == (float(wrong),)
    made = loop.report(plan=False)
    scores = made.evaluation.before["rmse"], made.evaluation.after["rmse"]
    # The noise, and what the wrong trial does to most others.
    assert scores[1].median() < 0.03 < scores[0].median()
    assert made.rmse_of_others[1] < made.rmse_of_others[0]


def test_what_nothing_explains_ends_no_loop():
    x = measured()
    x[2] = -1e30
    found = criticism(x).trace()
    assert found.verdict == "outlier"
    assert credible_set(found.outliers) == (2.0,)


def test_a_true_effect_stays_named_beside_the_outlier():
    xi = XI.clone()
    xi[1] = 4.0
    found = criticism(measured(xi, quadratic=3.0), xi=xi).trace()
    assert found.verdict == "quadratic"
    assert found.needed == ()
    assert found.probabilities["outlier"] < 1e-3


def test_an_effect_for_which_one_doubtful_trial_speaks_is_not_named():
    xi = torch.tensor([-2.0, -1.0, -1.5, 0.5, 2.0, 2.5, -1.0, 5.0])
    x = measured(xi, seed=3)
    x[7] += 9.0
    found = criticism(x, xi=xi).trace()
    assert found.verdict == "outlier"
    assert credible_set(found.outliers) == (7.0,)
    assert 7.0 in found.needed or not found.instead_of


@pytest.mark.parametrize("noise", [GaussianNoise(100.0), StudentTNoise(100.0, 4.0)])
def test_noise_declared_too_large_is_seen(noise):
    x = measured()
    found = criticism(x, model=SimulatorModel(response, noise=noise)).detect()
    assert found.lower_p_value < 1e-4
    assert criticism(x).detect().lower_p_value > 0.01


def test_noise_declared_too_large_is_seen_along_trajectories():
    noise, times = GaussianNoise(100 * oscillator.SENSOR), oscillator.TIMES
    model = SimulatorModel(oscillator.oscillate, noise=noise, sample_times=times)
    found = Criticism(model, oscillator.PRIOR, oscillator.trials()).detect()
    assert found.lower_p_value < 1e-4


def test_held_out_trials_refute_an_alias():
    xi = torch.tensor([-2.5, -0.5, 1.0, 0.5, -1.5, 2.0, 4.5, 5.0])
    x = measured(xi)
    x[6:] += torch.tensor([[10.0], [12.5]])  # twice the same slip
    further = torch.arange(3.0, 6.0, 0.25)
    both = torch.cat([x, measured(further, seed=5)])
    role = ["fit"] * 8 + ["held out"] * len(further)
    loop = criticism(both, xi=torch.cat([xi, further]), role=role)
    named = loop.trace()
    assert named.verdict == "quadratic"
    made = loop.report(plan=False)
    assert made.verdict in ("unexplained", "outlier")
    assert made.tracing.instead_of == "quadratic"
    assert made.simulator is loop.model
