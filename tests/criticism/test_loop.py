"""The loop on a small model whose truth is drawn in one place."""

import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import DiscreteActions, SimulatorModel
from sbi_active.criticism import (
    AugmentedSimulator,
    Context,
    Criticism,
    Effect,
    Trials,
    close_loop,
)
from tests.effects import BIAS, drift, effect, gain, normal, with_error

PRIOR = BoxUniform(-3 * torch.ones(2), 3 * torch.ones(2))
ACTIONS = DiscreteActions(torch.linspace(-2, 2, 17))
NOISE = 0.1


def response(theta, action, cubic=0.0):
    xi = action[:, 0]
    return (theta[:, 0] * xi + theta[:, 1] * xi**2 + cubic * xi**3)[:, None]


MODEL = SimulatorModel(response, noise=NOISE, parameter_names=["a", "b"])


ONE = Trials([1.0], [1.0])
#: Parts of which one is of another class, effects, and what is said of it.
MISPLACED = [
    ((response, PRIOR, ONE), [], "model, a SimulatorModel; got <function"),
    ((MODEL, MODEL, ONE), [], "prior, a Distribution; got SimulatorModel"),
    ((MODEL, PRIOR, "logs"), [], "trials, as Trials; got 'logs'"),
    ((MODEL, PRIOR, ONE), None, "list .* got None"),
    ((MODEL, PRIOR, ONE), ["bias"], r"got \['bias'\]"),
]


@pytest.mark.parametrize(("given", "effects", "message"), MISPLACED)
def test_parts_of_another_class_are_refused(given, effects, message):
    with pytest.raises(TypeError, match=message):
        close_loop(*given, effects=effects)


CUBIC = Effect.keyword("cubic", prior=normal(0.5))
DRIFT, GAIN = drift(0.2), gain(0.3)
LIBRARY = [BIAS, CUBIC, DRIFT, GAIN]


def measured(seed, phi, *, num=10, held_out=0):
    """Draw theta, actions and noise; return the trials alone."""
    gen = torch.Generator().manual_seed(seed)
    total = num + held_out
    theta = (6 * torch.rand(1, 2, generator=gen) - 3).expand(total, -1)
    action = ACTIONS.values[torch.randint(17, (total,), generator=gen)]
    real = AugmentedSimulator(MODEL, LIBRARY)
    phi = {k: torch.full((total, 1), v) for k, v in phi.items()}
    index = torch.arange(float(total))
    x = real.evaluate(theta, phi, action, context=Context(index))
    role = ["fit"] * num + ["held out"] * held_out
    return Trials(action, with_error(x, NOISE, gen), role=role)


#: By name: seed, size of each effect that is hidden, trials.
HIDDEN = {
    "bias": (1, {"bias": 0.8}, 10),
    "cubic": (1, {"cubic": -0.4}, 10),
    "drift": (1, {"drift": 0.15}, 10),
    "bias + cubic": (2, {"bias": 1.2, "cubic": -0.4}, 14),
}


@pytest.mark.parametrize("name", HIDDEN)
def test_hidden_effects_are_named_and_measured(name):
    seed, sizes, num = HIDDEN[name]
    criticism = Criticism(MODEL, PRIOR, measured(seed, sizes, num=num), effects=LIBRARY)
    tracing = criticism.trace()
    assert criticism.detect().alarm
    assert tracing.verdict == tracing.credible_set[0] == name
    assert sum(tracing.probabilities.values()) == pytest.approx(1.0)
    for k, probability in tracing.inclusion.items():
        assert (probability > 0.5) == (k in sizes)
    own = tracing.evidences[name]
    for k, size in zip(own.names[2:], sizes.values(), strict=True):
        draws = own.draws[:, own.names.index(k)]
        assert abs(draws.mean() - size) < 4 * draws.std()


def test_drift_is_bias_and_slope_where_actions_run_in_order():
    action = torch.linspace(-2, 2, 9)
    line = SimulatorModel(
        lambda theta, xi: theta[:, :1] + theta[:, 1:] * xi, noise=NOISE
    )
    trials = Trials(action, action)
    tracing = Criticism(line, PRIOR, trials, effects=[DRIFT], actions=ACTIONS).trace()
    assert tracing.verdict == "none"
    assert tracing.equivalent == ()


def test_below_eight_trials_an_error_has_no_interval():
    trials = measured(1, {"cubic": -0.5}, num=6)
    few = Criticism(MODEL, PRIOR, trials, effects=[BIAS, CUBIC]).evaluate()
    assert few.scheme == "leave one out"
    assert few.table["interval"].isna().all()


def test_nothing_is_added_to_a_right_model():
    trials = measured(6, {}, held_out=8)
    report = close_loop(MODEL, PRIOR, trials, effects=[BIAS, GAIN], plan=False)
    assert report.verdict == "none"
    assert report.simulator is MODEL
    assert report.prior is PRIOR
    assert (report.before_after["before"] == report.before_after["after"]).all()


def test_the_augmented_simulator_and_its_prior_go_on():
    trials = measured(1, {"bias": 0.8})
    given = {"effects": LIBRARY, "evaluate": False, "plan": False}
    report = close_loop(MODEL, PRIOR, trials, **given)
    z = report.prior.sample((7,))
    assert report.verdict == "bias"
    assert z.shape == (7, 3)
    assert report.simulator(z, ACTIONS.sample((7,), seed=0)).shape == (7, 1)
    again = Criticism(report.simulator, report.prior, trials, effects=[DRIFT, CUBIC])
    assert not again.detect().alarm


def test_trajectories_with_their_own_stamps_and_correlated_errors():
    times = torch.linspace(0, 2, 41)

    def decay(theta, action):
        return action * torch.exp(-theta[:, :1] * times.to(theta))

    model = SimulatorModel(decay, noise=0.05, sample_times=times)
    prior = BoxUniform(torch.tensor([0.2]), torch.tensor([3.0]))
    gen = torch.Generator().manual_seed(0)
    action = torch.tensor([1.0, -1.0, 2.0, -2.0, 1.5])

    def trials(bias):
        rows, stamps = [], []
        for num, a in enumerate(action, start=26):
            t = torch.sort(2 * torch.rand(num, generator=gen)).values
            kernel = torch.exp(-(t[:, None] - t).abs() / 0.3).double()
            z = torch.randn(num, generator=gen).double()
            noise = 0.05 * (torch.linalg.cholesky(kernel) @ z).float()
            rows.append(a * torch.exp(-0.8 * t) + bias + noise)
            rows[-1][2] = torch.nan
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


def test_noise_from_repeats_is_summed_out():
    bare = SimulatorModel(response)
    action = torch.cat([ACTIONS.values[::3], ACTIONS.values[:1].expand(4, 1)])
    x = with_error(response(torch.tensor([[1.0, -0.5]]), action), NOISE)
    clean = Criticism(bare, PRIOR, Trials(action, x), effects=[BIAS, GAIN])
    assert not clean.detect().alarm
    assert clean.residuals().noise == "estimated"
    assert len(clean.rivals.noise.cells) > 10  # draws of the standard deviation
    hidden = Criticism(bare, PRIOR, Trials(action, x + 1.5), effects=[BIAS, GAIN])
    assert hidden.trace().verdict == "bias"


def noisy(theta, action):
    return response(theta, action) + torch.randn(len(theta), 1)


def both(theta, action):
    return torch.cat([response(theta, action), 10 * action], 1)


TWO = SimulatorModel(both, noise=NOISE, channel_names=["rail [m]", "swing"])
TIMED = SimulatorModel(
    lambda theta, action: theta[:, :1] * torch.linspace(0, 1, 5).to(theta),
    noise=NOISE,
    sample_times=torch.linspace(0, 1, 5),
)
LABELS = ["swing [rad]", "rail [m]"]


ONES, MORE = torch.ones(3), torch.ones(3, 3)
SCATTER = effect("scatter", hook="noise", apply=lambda sd, *_: sd)


SWAPPED = Trials(ONES, torch.ones(3, 2), channel_labels=LABELS)
BEYOND = Trials(ONES, MORE, sample_times=[0, 0.5, 1.5])


#: What lacks, and what is said of it.
INCOMPARABLE = [
    ("at least 3 repeats of one action", {"model": SimulatorModel(response)}),
    ("noise would count twice", {"model": SimulatorModel(noisy, noise=NOISE)}),
    ("at least two valid trials to fit; got 1", {"trials": measured(1, {}, num=1)}),
    ("trials of the simulator's shape", {"trials": Trials(ONES, torch.ones(3, 4))}),
    ("x of 5 samples a trial", {"model": TIMED, "trials": Trials(ONES, ONES)}),
    ("expected effects not named none", {"effects": [SCATTER]}),
    ("actions of dimension 1", {"actions": DiscreteActions([[1.0, 2.0]])}),
    ("rail, swing; got swing, rail", {"model": TWO, "trials": SWAPPED}),
    ("those of the simulator, 0 to 1", {"model": TIMED, "trials": BEYOND}),
]


@pytest.mark.parametrize(("message", "changes"), INCOMPARABLE)
def test_what_cannot_be_compared(message, changes):
    given = {"model": MODEL, "trials": measured(1, {}), **changes}
    with pytest.raises(ValueError, match=message):
        Criticism(prior=PRIOR, **given)
