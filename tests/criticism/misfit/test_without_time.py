"""Numbers that do not follow each other in time, beside what nobody declared."""

import math

import pytest
import torch
from torch import Tensor
from torch.distributions import Independent, Normal

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Criticism, Effect, Trials

SENSOR, NUM_TRIALS = 0.05, 16
THETA, QUADRATIC, HIDDEN = (1.0, 0.5), 0.8, 0.4
PRIOR = Independent(Normal(torch.zeros(2), 2 * torch.ones(2)), 1)
EFFECTS = [
    Effect.keyword("quadratic", prior=Normal(0.0, 1.0)),
    Effect.keyword("step", prior=Normal(0.0, 1.0)),
]


def line(
    theta: Tensor,
    action: Tensor,
    *,
    quadratic: Tensor | float = 0.0,
    step: Tensor | float = 0.0,
    hidden: Tensor | float = 0.0,
) -> Tensor:
    """Return one number a trial, (n, 1)."""
    a = action[:, 0].to(theta)
    x = theta[:, 0] + theta[:, 1] * a + quadratic * a**2 + step * (a > 0)
    return (x + hidden * torch.sin(4 * a))[:, None]


def trials(*, quadratic: float = 0.0, step: float = 0.0, hidden: float = 0.0) -> Trials:
    action = torch.linspace(-2, 2, NUM_TRIALS)[:, None]
    theta = torch.tensor(THETA).expand(NUM_TRIALS, -1)
    x = line(theta, action, quadratic=quadratic, step=step, hidden=hidden)
    generator = torch.Generator().manual_seed(3)
    return Trials(action, x + SENSOR * torch.randn(x.shape, generator=generator))


def loop(own: Trials, **options) -> Criticism:
    model = SimulatorModel(line, noise=GaussianNoise(SENSOR), batched=True)
    return Criticism(model, PRIOR, own, effects=EFFECTS, seed=0, summaries=0, **options)


@pytest.fixture(scope="module")
def beside():
    """Trials with a quadratic term, beside a wave that nobody declared."""
    return loop(trials(quadratic=QUADRATIC, hidden=HIDDEN))


def test_the_cause_is_named(beside):
    tracing = beside.trace()
    assert tracing.verdict == "quadratic"
    assert tracing.misfit.named == ("quadratic",)
    assert not tracing.misfit.passes
    assert 2 < tracing.misfit.size < 20
    assert math.isnan(tracing.misfit.time_scale)


def test_intervals_hold_what_nobody_declared(beside):
    report = beside.report(evaluate=False, plan=False)
    found = report.parameters.set_index("parameter")
    for name, truth in zip(
        ["theta_1", "theta_2", "quadratic"], (*THETA, QUADRATIC), strict=True
    ):
        mean, sd = found.loc[name, ["after", "after_sd"]]
        assert abs(mean - truth) < 3 * sd
        assert sd > 0.4 * HIDDEN / NUM_TRIALS**0.5


def test_a_formula_that_does_better_leaves_an_imitation_unnamed():
    """A power of 1.5 is not declared; the quadratic takes up 99 % of its excess."""

    def curved(theta: Tensor, action: Tensor) -> Tensor:
        return line(theta, action) + 2 * action[:, :1].to(theta).abs() ** 1.5

    own = trials()
    x = own.x + curved(torch.zeros(NUM_TRIALS, 2), own.action)
    found = loop(Trials(own.action, x))
    report = found.report(evaluate=False, plan=False)
    misfit = report.tracing.misfit
    assert misfit.helps == ("quadratic",)
    assert misfit.support["quadratic"].remains < 0.02
    assert misfit.support["quadratic"].guessed > 10
    assert misfit.named == ()
    assert report.guess == "|xi|^1.5"


def test_a_cause_has_no_rival_among_formulas(beside):
    guessed = beside.trace().misfit.support["quadratic"].guessed
    # One of about twenty is the effect itself: the mean is log(20) = 3 nats below it.
    assert -4 < guessed < 0


def test_several_effects_are_asked_what_left_out_trials_say_of_them():
    found = loop(trials(quadratic=QUADRATIC, step=1.0))
    tracing = found.trace()
    assert tracing.verdict == "quadratic + step"
    assert found.misfit() is not None
    assert {*tracing.misfit.named} == {*tracing.chosen}
    draws = tracing.evidences["quadratic"].draws  # without the step, which matters
    mean, sd = draws.mean(0), draws.std(0)
    assert (abs(mean - (*THETA, QUADRATIC)) < 2 * sd).all()


def test_a_model_that_one_effect_refutes_has_intervals_that_know_of_it():
    tracing = loop(trials(quadratic=QUADRATIC)).trace()
    draws = tracing.evidences["none"].draws
    mean, sd = draws.mean(0), draws.std(0)
    assert abs(mean[0] - THETA[0]) > 10 * SENSOR  # the quadratic's mean is in it
    assert (abs(mean - THETA) < 2 * sd).all()


def test_a_model_that_fits_is_no_misfit():
    found = loop(trials(quadratic=QUADRATIC))
    assert found.trace().verdict == "quadratic"
    assert found.misfit() is None
    assert found.trace().misfit is None


def test_held_out_errors_are_told_number_by_number_as_left_out_ones_are():
    """Two numbers in units of their own: their errors have no common size."""
    unit, gen = torch.tensor([1.0, 100.0]), torch.Generator().manual_seed(3)

    def both(theta, action, **effects):
        return line(theta, action, **effects) * unit

    action = torch.linspace(-2, 2, 24)[torch.randperm(24, generator=gen)][:, None]
    x = both(torch.tensor(THETA).expand(24, -1), action, quadratic=0.8, hidden=HIDDEN)
    x = x + SENSOR * unit * torch.randn(x.shape, generator=gen)
    role = ["fit"] * NUM_TRIALS + ["held out"] * 8
    model = SimulatorModel(both, noise=GaussianNoise(SENSOR * unit), batched=True)
    own = Trials(action, x, role=role)
    misfit = Criticism(model, PRIOR, own, effects=EFFECTS, summaries=0).trace().misfit
    for found in misfit.models:
        held_out = found.held_out / unit.numpy()
        assert held_out.max() < 2 * held_out.min()
        assert found.left_out.shape == found.held_out.shape
