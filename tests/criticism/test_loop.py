"""The loop on a small model whose truth is drawn in one place."""

import math

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.criticism import (
    AugmentedSimulator,
    Criticism,
    Effect,
    Trials,
    close_loop,
    generic_effects,
)
from tests.effects import BIAS, effect, half, normal, on_outcomes

PRIOR = BoxUniform(-3 * torch.ones(2), 3 * torch.ones(2))
ACTIONS = DiscreteActions(torch.linspace(-2, 2, 17))
NOISE = 0.1


def response(theta, action, cubic=0.0):
    xi = action[:, 0]
    return (theta[:, 0] * xi + theta[:, 1] * xi**2 + cubic * xi**3)[:, None]


MODEL = SimulatorModel(response, noise=GaussianNoise(NOISE), parameter_names=["a", "b"])


CUBIC = Effect.keyword("cubic", prior=normal(0.5))
DRIFT = on_outcomes(
    "drift", lambda x, phi, action, context: x + phi * context.index[:, None], sd=0.2
)
GAIN = on_outcomes("gain", lambda x, phi, action, context: x * (1 + phi), sd=0.3)
LIBRARY = [BIAS, CUBIC, DRIFT, GAIN]
OUTSIDE = on_outcomes(
    "ripple", lambda x, phi, action, context: x + phi * torch.sin(4 * action)
)


def measured(seed, phi, *, num=10, held_out=0):
    """Draw theta, actions and noise; return the trials alone."""
    gen = torch.Generator().manual_seed(seed)
    total = num + held_out
    theta = (6 * torch.rand(1, 2, generator=gen) - 3).expand(total, -1)
    action = ACTIONS.values[torch.randint(17, (total,), generator=gen)]
    real = AugmentedSimulator(MODEL, [*LIBRARY, OUTSIDE])
    phi = {k: torch.full((total, 1), v) for k, v in phi.items()}
    index = torch.arange(float(total))
    x = real.evaluate(theta, phi, action, index=index)
    x = x + NOISE * torch.randn(x.shape, generator=gen)
    role = ["fit"] * num + ["held out"] * held_out
    return Trials(action, x, role=role)


@pytest.mark.parametrize("name", ["bias", "cubic", "drift"])
def test_a_hidden_effect_is_named_and_measured(name):
    size = {"bias": 0.8, "cubic": -0.4, "drift": 0.15}[name]
    criticism = Criticism(MODEL, PRIOR, measured(1, {name: size}), effects=LIBRARY)
    tracing = criticism.trace()
    assert criticism.detect().alarm
    assert tracing.verdict == name
    assert tracing.credible_set[0] == name
    estimate = next(e for e in tracing.estimates if e.name == name)
    assert abs(estimate.mean[0] - size) < 4 * estimate.sd[0]
    assert sum(tracing.probabilities.values()) == pytest.approx(1.0)


def test_two_hidden_effects():
    trials = measured(2, {"bias": 1.2, "cubic": -0.4}, num=14)
    tracing = Criticism(MODEL, PRIOR, trials, effects=LIBRARY).trace()
    assert tracing.verdict == "bias + cubic"
    assert tracing.inclusion["bias"] > 0.9
    assert tracing.inclusion["drift"] < 0.2


@pytest.mark.slow
def test_what_the_library_lacks_is_not_traced_to_it():
    trials = measured(3, {"ripple": 1.0}, num=16)
    tracing = Criticism(MODEL, PRIOR, trials, effects=LIBRARY, actions=ACTIONS).trace()
    assert tracing.verdict in ("unexplained", "scatter")


def test_a_removed_effect_is_guessed_by_its_formula():
    trials = measured(4, {"bias": 0.9}, num=14)
    declared = [GAIN, DRIFT]
    tracing = Criticism(MODEL, PRIOR, trials, effects=declared, actions=ACTIONS).trace()
    assert tracing.verdict == "unexplained"
    assert tracing.guesses[0][0] in ("1", "cos(xi)")
    assert tracing.guesses[0][1] > 3


def test_large_noise_is_scatter_and_no_cause():
    trials = measured(5, {}, num=14)
    noisy = Trials(
        trials.action,
        trials.x + 0.6 * torch.randn(14, 1, generator=torch.Generator().manual_seed(0)),
    )
    tracing = Criticism(MODEL, PRIOR, noisy, effects=LIBRARY).trace()
    assert tracing.verdict == "scatter"
    assert tracing.chosen == ()


def test_effects_that_no_action_separates():
    twin = on_outcomes("offset", lambda x, phi, action, context: x + 2 * phi)
    trials = measured(1, {"bias": 0.8})
    effects = [*LIBRARY, twin]
    tracing = Criticism(MODEL, PRIOR, trials, effects=effects, actions=ACTIONS).trace()
    assert frozenset({"none", "gain"}) in tracing.equivalent
    assert frozenset({"bias", "offset"}) in tracing.equivalent
    assert len(tracing.equivalent) == 2


def test_drift_is_bias_and_slope_where_actions_run_in_order():
    action = torch.linspace(-2, 2, 9)
    line = SimulatorModel(
        lambda theta, xi: theta[:, :1] + theta[:, 1:] * xi, noise=GaussianNoise(NOISE)
    )
    trials = Trials(action, action)
    tracing = Criticism(line, PRIOR, trials, effects=[DRIFT], actions=ACTIONS).trace()
    assert tracing.near == (frozenset({"none", "drift"}),)
    assert tracing.equivalent == ()


def test_the_error_falls_on_held_out_trials():
    trials = measured(1, {"cubic": -0.5}, held_out=10)
    criticism = Criticism(MODEL, PRIOR, trials, effects=LIBRARY, actions=ACTIONS)
    evaluation = criticism.evaluate()
    table = evaluation.table.set_index("metric")
    assert evaluation.scheme == "held out"
    assert table.loc["rmse", "ratio"] < 0.5
    assert table.loc["rmse", "high"] < 1
    # RMSE of 10 numbers with noise of 0.1: standard error 0.1 / sqrt(20).
    assert table.loc["rmse", "after"] < NOISE * (1.2 + 4 / math.sqrt(20))


def test_leaving_one_out_repeats_the_selection():
    trials = measured(1, {"cubic": -0.5}, num=6)
    evaluation = Criticism(MODEL, PRIOR, trials, effects=[BIAS, CUBIC]).evaluate()
    assert evaluation.scheme == "leave one out"
    assert len(evaluation.selected) == 6
    assert np.isnan(evaluation.table["low"]).all()  # below 8 trials there is none


def test_nothing_is_added_to_a_right_model():
    trials = measured(6, {}, held_out=8)
    report = close_loop(MODEL, PRIOR, trials, effects=[BIAS, GAIN], plan=False)
    assert report.verdict == "none"
    assert report.simulator is MODEL
    assert report.prior is PRIOR
    assert (report.before_after["before"] == report.before_after["after"]).all()


def test_the_augmented_simulator_and_its_prior_go_on():
    trials = measured(1, {"bias": 0.8})
    report = close_loop(
        MODEL, PRIOR, trials, effects=LIBRARY, evaluate=False, plan=False
    )
    z = report.prior.sample((7,))
    assert report.verdict == "bias"
    assert z.shape == (7, 3)
    assert report.simulator(z, ACTIONS.sample((7,), seed=0)).shape == (7, 1)
    again = Criticism(report.simulator, report.prior, trials, effects=[DRIFT, CUBIC])
    assert not again.detect().alarm


@pytest.mark.slow
def test_a_stochastic_simulator_has_a_synthetic_likelihood():
    def draw(theta, action):
        return response(theta, action) + NOISE * torch.randn(len(theta), 1)

    model = SimulatorModel(draw)
    for phi, verdict in (({}, "none"), ({"bias": 0.9}, "bias")):
        criticism = Criticism(model, PRIOR, measured(1, phi), effects=[BIAS, DRIFT])
        assert criticism.trace().verdict == verdict
    assert criticism.residuals().noise == "stochastic"


def test_trajectories_with_their_own_stamps_and_correlated_errors():
    times = torch.linspace(0, 2, 41)

    def decay(theta, action):
        return action * torch.exp(-theta[:, :1] * times.to(theta))

    model = SimulatorModel(decay, noise=GaussianNoise(0.05), sample_times=times)
    prior = BoxUniform(torch.tensor([0.2]), torch.tensor([3.0]))
    gen = torch.Generator().manual_seed(0)
    action = torch.tensor([1.0, -1.0, 2.0, -2.0, 1.5])

    def trials(bias):
        rows, stamps = [], []
        for a in action:
            t = torch.sort(2 * torch.rand(30, generator=gen)).values
            e, noise = torch.zeros(()), []
            for gap in torch.diff(t, prepend=t[:1] - 1):
                rho = math.exp(-float(gap) / 0.3)
                e = rho * e + math.sqrt(1 - rho**2) * torch.randn((), generator=gen)
                noise.append(0.05 * e)
            rows.append(a * torch.exp(-0.8 * t) + bias + torch.stack(noise))
            stamps.append(t)
        return Trials(action, rows, sample_times=stamps)

    clean = Criticism(model, prior, trials(0.0), effects=[BIAS, GAIN])
    assert not clean.detect().alarm
    assert clean.residuals().correlation > 0.5
    hidden = Criticism(model, prior, trials(0.3), effects=[BIAS, GAIN])
    assert hidden.trace().verdict == "bias"


def test_a_nuisance_of_each_trial_is_no_effect():
    start = effect("start", prior=normal(0.5), scope="trial")
    trials = measured(7, {}, num=8)
    shifts = 0.5 * torch.randn(8, 1, generator=torch.Generator().manual_seed(1))
    moved = Trials(trials.action, trials.x + shifts)
    assert Criticism(MODEL, PRIOR, moved, effects=[CUBIC]).detect().alarm
    criticism = Criticism(MODEL, PRIOR, moved, effects=[CUBIC, start])
    assert not criticism.detect().alarm
    assert "start" not in criticism.trace().probabilities


def test_outcomes_that_disagree_are_a_residual():
    def falls(theta, action):
        x = response(theta, action)
        return torch.where(action > 1.4, torch.nan, x)

    model = SimulatorModel(falls, noise=GaussianNoise(NOISE))
    edge = effect(
        "edge",
        hook="action",
        prior=half(),
        apply=lambda value, phi, action, context: value - phi * (value > 0),
    )
    trials = measured(8, {}, num=12)
    # The real system keeps all, up to the largest action.
    criticism = Criticism(model, PRIOR, trials, effects=[edge])
    agree = Criticism(MODEL, PRIOR, trials, effects=[edge])
    lost = criticism.rivals.fit().evidence.log_evidence
    assert lost < agree.rivals.fit().evidence.log_evidence - 3


def test_generic_effects_find_an_offset_of_the_actuator():
    trials = measured(11, {}, num=16)
    shifted = Trials(trials.action - 0.4, trials.x)  # executed 0.4 above commanded
    effects = generic_effects(MODEL, ACTIONS, prior=PRIOR)
    tracing = Criticism(MODEL, PRIOR, shifted, effects=effects).trace()
    assert frozenset({"action offset", "bias"}) in tracing.near
    assert tracing.verdict in ("action offset", "bias")


def test_noise_from_repeats_is_summed_out():
    bare = SimulatorModel(response)
    gen = torch.Generator().manual_seed(0)
    action = torch.cat([ACTIONS.values[::3], ACTIONS.values[:1].expand(4, 1)])
    x = response(torch.tensor([[1.0, -0.5]]), action)
    x = x + NOISE * torch.randn(x.shape, generator=gen)
    clean = Criticism(bare, PRIOR, Trials(action, x), effects=[BIAS, GAIN])
    assert not clean.detect().alarm
    assert clean.residuals().noise == "estimated"
    assert len(clean.rivals.noise.cells) > 10  # draws of the standard deviation
    hidden = Criticism(bare, PRIOR, Trials(action, x + 1.5), effects=[BIAS, GAIN])
    assert hidden.trace().verdict == "bias"


def noisy(theta, action):
    return response(theta, action) + torch.randn(len(theta), 1)


ONES, LOST = torch.ones(3), torch.tensor([torch.nan, torch.nan, 1.0])
SCATTER = effect("scatter", hook="noise", apply=lambda sd, *_: sd)


@pytest.mark.parametrize(
    ("message", "changes"),
    [
        ("at least 3 repeats of one action", {"model": SimulatorModel(response)}),
        ("noise would count twice", {"model": SimulatorModel(noisy, noise=NOISE)}),
        ("at least two valid trials to fit; got 1", {"trials": measured(1, {}, num=1)}),
        ("trials of the simulator's shape", {"trials": Trials(ONES, torch.ones(3, 4))}),
        (
            "at least two valid trials to fit; got 0",
            {"trials": Trials(ONES, LOST, role=["fit", "fit", "held out"])},
        ),
        ("expected effects not named none", {"effects": [SCATTER]}),
        ("actions of dimension 1", {"actions": DiscreteActions([[1.0, 2.0]])}),
    ],
)
def test_what_cannot_be_compared(message, changes):
    given = {"model": MODEL, "trials": measured(1, {}), **changes}
    with pytest.raises(ValueError, match=message):
        Criticism(prior=PRIOR, **given)


def test_channels_in_another_order_are_refused():
    def both(theta, action):
        return torch.cat([response(theta, action), 10 * action], 1)

    model = SimulatorModel(
        both, noise=GaussianNoise(NOISE), channel_names=["rail [m]", "swing"]
    )
    x = both(torch.ones(4, 2), action := torch.arange(4.0)[:, None])
    labels = ["swing [rad]", "rail [m]"]
    trials = Trials(action, x.flip(1), channel_labels=labels)
    with pytest.raises(ValueError, match="channels, rail, swing; got swing, rail"):
        Criticism(model, PRIOR, trials)
    Criticism(model, PRIOR, Trials(action, x, channel_labels=labels[::-1]))
