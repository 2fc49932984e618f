"""Evidence between models that are all wrong counts less; else it counts in full."""

import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import Normal

from sbi_active import SimulatorModel
from sbi_active.criticism import Criticism, Effect, Trials
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.steps import power
from sbi_active.criticism.steps.coarsening import coarsening
from sbi_active.simulation import AutocorrelatedNoise

SENSOR = 0.01
TIMES = torch.linspace(0.05, 2.0, 40)
PRIOR = BoxUniform(torch.zeros(1), 2 * torch.ones(1))


def drag(exponent):
    return Effect(
        f"t^{exponent:g}",
        hook="observation",
        prior=Normal(torch.zeros(1), torch.ones(1)),
        null=0.0,
        apply=lambda x, phi, action, context: x + phi * action * TIMES**exponent,
    )


def step(t):
    """No sum of the two powers follows it."""
    return 2 * torch.tanh(8 * (t - 1))


EFFECTS = [drag(1.5), drag(3.0)]


def trace(shape, *, measurement_sd=SENSOR):
    """Trials with an undeclared effect of some shape in time."""
    noise = AutocorrelatedNoise.unknown(
        sd=(0.5 * SENSOR, 1.0),
        correlation_time=(0.01, 5.0),
        num_sds=20,
        num_times=6,
        measurement_sd=measurement_sd,
    )
    model = SimulatorModel(
        lambda theta, action: theta * action * (5 * TIMES).sin(),
        noise=noise,
        sample_times=tuple(TIMES.tolist()),
    )
    gen = torch.Generator().manual_seed(0)
    action = 1 + torch.rand(4, 1, generator=gen)
    x = 0.8 * action * (5 * TIMES).sin() - 0.2 * action * shape(TIMES)
    x = x + SENSOR * torch.randn(x.shape, generator=gen)
    trials = Trials(action, x, sample_times=TIMES)
    loop = Criticism(model, PRIOR, trials, effects=EFFECTS, thin=False, seed=0)
    return loop, loop.trace()


def test_between_models_that_are_all_wrong_a_trial_counts_once():
    _, sure = trace(step, measurement_sd=None)
    loop, coarse = trace(step)
    assert sure.coarsening == 1.0
    # Errors are several times the sensor's, so that a trial counts little more than one
    # of its 40 numbers.
    assert 1 / 40 < coarse.coarsening < 0.2
    best = next(iter(sure.probabilities))
    assert coarse.probabilities[best] < sure.probabilities[best]
    assert len(coarse.credible_set) > len(sure.credible_set)
    assert "every model misses" in " ".join(str(loop.report(evaluate=False)).split())


def test_a_model_that_is_right_keeps_its_evidence():
    _, right = trace(lambda t: t**1.5)
    assert right.verdict == "t^1.5"
    assert right.coarsening > 0.7
    assert right.probabilities["t^1.5"] > 0.95


@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_a_channel_in_another_unit_counts_as_in_the_same(unit):
    """The second channel is known to the sensor's error, the first is missed."""
    units = torch.tensor([1.0, unit])

    def fn(theta, action):
        both = [theta * action * (5 * TIMES).sin(), theta * action * (3 * TIMES).cos()]
        return torch.stack(both, -1) * units

    noise = AutocorrelatedNoise(
        torch.tensor([20 * SENSOR, SENSOR]) * units, 1e-3, measurement_sd=SENSOR * units
    )
    model = SimulatorModel(fn, noise=noise, sample_times=tuple(TIMES.tolist()))
    gen = torch.Generator().manual_seed(0)
    action = 1 + torch.rand(4, 1, generator=gen)
    x = fn(torch.full((4, 1), 0.8), action)
    x = x + SENSOR * units * torch.randn(x.shape, generator=gen)
    x[..., 0] -= 0.2 * action * step(TIMES)
    loop = Criticism(model, PRIOR, Trials(action, x, sample_times=TIMES), thin=False)
    none = ModelKey()
    loop.rivals.fit(none)
    # Half of the numbers count in full, the others a 400th, and else once a trial.
    share = (1 + 1 / 400) / 2
    expected = power(share, num_trials=4, num_measurements=320)
    assert coarsening(loop.rivals, {none: 0.0}) == pytest.approx(expected, rel=1e-6)


def test_the_power_lies_between_a_trial_and_a_number():
    assert power(0.0, num_trials=4, num_measurements=100) == 0.04
    assert power(0.5, num_trials=4, num_measurements=100) == 0.52
    assert power(3.0, num_trials=4, num_measurements=100) == 1.0


def test_an_error_of_measurement_is_positive():
    with pytest.raises(ValueError, match="expected measurement_sd > 0; got 0"):
        AutocorrelatedNoise(0.1, 1.0, measurement_sd=0.0)
