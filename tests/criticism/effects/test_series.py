"""Effects along a trajectory, by action and by order, against plain versions."""

import warnings

import numpy as np
import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import SimulatorModel
from sbi_active.criticism import Trials, close_loop, varying_parameters
from sbi_active.criticism.effects import changes
from sbi_active.criticism.effects.first_samples import start_from_first_samples

STEP = torch.tensor(0.1).double()


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).double()


def column(*values):
    return torch.tensor(values).double()[:, None]


def test_a_lag_is_that_of_fine_integration():
    u, tau = random(3, 40), column(0.03, 0.1, 0.5)
    fine = 2000
    for row in range(3):
        y, means = float(u[row, 0]), []
        for value in u[row].tolist():
            path = []
            for _ in range(fine):
                path.append(y)
                y += float(STEP) / fine * (value - y) / float(tau[row])
            means.append(np.mean([*path[1:], y]) / 2 + np.mean(path) / 2)
        found = changes.lagged_input(u[row : row + 1], tau[row : row + 1], STEP)
        assert found[0].numpy() == pytest.approx(np.array(means), abs=2e-3)


def test_a_delay_by_steps_shifts():
    u = random(2, 30)
    found = changes.delayed_input(u, column(0.2, 0.0), STEP)
    assert torch.allclose(found[0, 2:], u[0, :-2])
    assert torch.equal(found[0, :2], u[0, :1].expand(2))
    assert torch.equal(found[1], u[1])
    half = changes.delayed_input(u, column(0.05, 0.05), STEP)
    assert torch.allclose(half[:, 1:], (u[:, 1:] + u[:, :-1]) / 2)


def test_a_backlash_is_that_of_its_definition():
    u, width = random(3, 57).cumsum(1), column(0.0, 1.0, 4.0)
    expected = torch.empty_like(u)
    y = u[:, 0]
    for k in range(57):
        half = width[:, 0] / 2
        y = torch.minimum(torch.maximum(y, u[:, k] - half), u[:, k] + half)
        expected[:, k] = y
    assert torch.equal(changes.played(u, width), expected)
    assert torch.equal(expected[0], u[0])


@pytest.mark.parametrize("channels", [(), (2,)])
def test_a_sensor_s_lag_is_that_of_fine_integration(channels):
    times = torch.tensor([0.0, 0.1, 0.25, 0.3, 0.7, 1.0]).double()
    x, tau = random(2, 6, *channels), column(0.05, 0.4)
    found = changes.lagged_samples(x, tau, times.expand(2, -1))
    fine = np.linspace(0, 1, 10_001)
    for row in range(2):
        for c in np.ndindex(*channels):
            truth = np.interp(fine, times.numpy(), x[row][(slice(None), *c)].numpy())
            y, path = truth[0], []
            keep = np.exp(-1e-4 / float(tau[row]))
            for value in truth:
                y = keep * y + (1 - keep) * value
                path.append(y)
            expected = np.interp(times.numpy(), fine, path)
            own = found[row][(slice(None), *c)].numpy()
            assert own == pytest.approx(expected, abs=4e-3)
    # Padding is no number, and costs none.
    padded = [torch.cat([v, v[:, -1:]], 1) for v in (x, times.expand(2, -1))]
    longer = changes.lagged_samples(padded[0], tau, padded[1])
    assert torch.allclose(longer[:, :6], found)
    assert bool(longer.isfinite().all())


def test_a_sensor_s_delay_reads_between_its_samples_and_a_quantum_rounds():
    times = torch.tensor([[0.0, 0.1, 0.3, 0.3, 0.3]]).double()  # padded
    x = torch.tensor([[1.0, 2.0, 4.0, 4.0, 4.0]]).double()
    both = changes.delayed_samples(torch.stack([x, -x], -1), column(0.05), times)
    for channel, sign in ((0, 1), (1, -1)):
        found = sign * both[0, :3, channel]
        assert found.tolist() == pytest.approx([1.0, 1.5, 3.5])
    assert torch.equal(changes.delayed_samples(x, column(0.0), times), x)
    x = torch.tensor([[0.12, -0.37]]).double()
    assert changes.rounded(x, column(0.1))[0].tolist() == pytest.approx([0.1, -0.4])
    assert torch.equal(changes.rounded(x, column(0.0)), x)


STEPS = 0.1 * torch.arange(50)[None].double()
CHANGES = {
    "input lag": lambda u, phi: changes.lagged_input(u, phi, STEP),
    "input delay": lambda u, phi: changes.delayed_input(u, phi, STEP),
    "backlash": changes.played,
    "sensor lag": lambda x, phi: changes.lagged_samples(x, phi, STEPS),
    "sensor delay": lambda x, phi: changes.delayed_samples(x, phi, STEPS),
}


@pytest.mark.parametrize("name", CHANGES)
def test_none_is_flat_at_its_null(name):
    """A tiny phi changes the series in proportion: the derivative at 0 exists."""
    u, change = random(1, 50), CHANGES[name]
    assert torch.equal(change(u, column(0.0)), u)
    small, smaller = (change(u, column(p)) - u for p in (1e-5, 1e-7))
    assert float(smaller.norm()) > 1e-8
    assert torch.allclose(small / 1e-5, smaller / 1e-7, rtol=1e-2, atol=1e-2)


# Nuisances that are centered on the first samples of each trial


SENSOR = 0.02
TIMES = torch.linspace(0.1, 2.0, 20).double()


def lines(num=400):
    """Return motions of constant speed, their starts at time 0, and their speeds."""
    rng = np.random.default_rng(0)
    place, speed = torch.from_numpy(rng.normal(size=(2, num, 1)))
    x = place + speed * TIMES + SENSOR * torch.from_numpy(rng.normal(size=(num, 20)))
    trials = Trials(torch.arange(float(num)), x, sample_times=TIMES)
    return trials, place[:, 0], speed[:, 0]


def test_errors_of_the_center_are_those_that_the_width_says():
    trials, place, speed = lines()
    wanted = {"place": 0, "speed": (0, 1)}
    own = {"within": 0.55, "sd": SENSOR, "at": 0.0, "width": 1.0}
    found, nuisance = start_from_first_samples(trials, wanted, **own)
    deviations = nuisance.prior.stddev
    for name, truth, sd in zip(wanted, (place, speed), deviations, strict=True):
        z = (found.start[name] - truth) / sd
        assert float(z.std()) == pytest.approx(1, rel=0.1)
        assert abs(float(z.mean())) < 4 / len(z) ** 0.5
    wide = start_from_first_samples(trials, wanted, within=0.55, sd=SENSOR, at=0.0)[1]
    assert torch.allclose(wide.prior.stddev, 3 * deviations)
    assert trials.start is None


def test_the_start_is_that_of_each_trial_s_own_first_sample_unless_told():
    x = [5 + 2 * (TIMES - 0.1), 7 - TIMES[4:]]
    trials = Trials([1.0, 2.0], x, sample_times=[TIMES, TIMES[4:]])
    wanted = {"speed": (0, 1), "place": 0}
    found, _ = start_from_first_samples(trials, wanted, within=0.3, sd=SENSOR)
    assert found.start["place"].tolist() == pytest.approx([5, 7 - 0.5])
    assert found.start["speed"].tolist() == pytest.approx([2, -1])


def test_a_second_derivative_and_channels_of_their_own_errors():
    x = torch.stack([4 + 0.5 * 3 * TIMES**2, 0 * TIMES + 1], -1)[None]
    trials = Trials([1.0], x, sample_times=TIMES, start={"load": [8.0]})
    deviations = []
    for times in (10, 1):
        found, nuisance = start_from_first_samples(
            *(trials, {"force": (0, 2), "angle": 1}),
            **{"within": 0.6, "sd": [SENSOR, times * SENSOR], "at": 0.0},
        )
        deviations.append(nuisance.prior.stddev)
    start = {k: float(v) for k, v in found.start.items()}
    assert start == pytest.approx({"load": 8.0, "force": 3.0, "angle": 1.0})
    assert (deviations[0] / deviations[1]).tolist() == pytest.approx([1, 10])


def test_a_line_that_hides_gravity_is_said():
    times = torch.arange(10) / 30
    noise = 0.01 * torch.randn(3, 10, generator=torch.Generator().manual_seed(0))
    fall = 5 * times - 9.81 * times**2 / 2 + noise
    trials = Trials([1.0, 2.0, 3.0], fall, sample_times=times, names=["a", "b", "c"])
    speeds = {"y": 0, "vy": (0, 1)}
    with pytest.warns(UserWarning, match="a, b, c leave a polynomial of order 1"):
        start_from_first_samples(trials, speeds, within=0.4, sd=0.01)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # neither with the fall nor within two frames
        start_from_first_samples(trials, {**speeds, "ay": (0, 2)}, within=0.4, sd=0.01)
        start_from_first_samples(trials, speeds, within=0.05, sd=0.01)


# Parameters that depend on the action or the order of the trials


SPEED = torch.tensor([1.0, 2.5, 1.5, 3.0, 2.0, 0.75, 2.75, 1.25])
FRICTION = BoxUniform(torch.tensor([0.1, 0.0]), torch.tensor([1.0, 0.3]))


def stopping(theta, action):
    """Return the way to a stop (m) and its time (s), with a delay of the brake."""
    friction, delay = theta[:, :1], theta[:, 1:]
    way = action**2 / (2 * 9.81 * friction) + delay * action
    return torch.cat([way, action / (9.81 * friction) + delay], 1)


STOPPING = SimulatorModel(stopping, noise=0.003, parameter_names=["friction", "delay"])


def trials_of(friction):
    torch.manual_seed(0)
    x = stopping(torch.stack([friction, torch.full((8,), 0.1)], 1), SPEED[:, None])
    x = x + 0.003 * torch.randn(x.shape)
    return Trials(SPEED, x, action_labels=["speed [m/s]"])


#: Frictions, and the verdict.
DEPENDING = [
    (0.5 + 0.1 * (SPEED - 1.875), "friction by speed"),
    (0.5 + 0.02 * (torch.arange(8) - 3.5), "friction by trial"),
    (torch.full((8,), 0.5), "none"),
]


@pytest.mark.parametrize(("friction", "verdict"), DEPENDING)
def test_what_a_parameter_depends_on_is_named(friction, verdict):
    trials = trials_of(friction)
    effects = varying_parameters(STOPPING, FRICTION, trials)
    given = {"effects": effects, "evaluate": False, "plan": False}
    report = close_loop(STOPPING, FRICTION, trials, **given)
    assert report.verdict == verdict


def test_parameters_stay_within_their_prior_and_vary_by_what_varies():
    trials = trials_of(torch.full((8,), 0.5))
    effect = varying_parameters(STOPPING, FRICTION, trials)[0]
    theta = torch.tensor([[0.9, 0.1], [0.2, 0.1], [0.5, 0.1]])
    action, phi = torch.tensor([[3.0], [0.75], [1.875]]), torch.full((3, 1), 9.0)
    moved = effect.apply(theta.clone(), phi, action, None)
    expected = torch.tensor([[1.0, 0.1], [0.1, 0.1], [0.5, 0.1]])
    torch.testing.assert_close(moved, expected)
    assert torch.equal(effect.apply(theta.clone(), 0 * phi, action, None), theta)
    constant = Trials(torch.ones(4), torch.zeros(4, 2), order="unknown")
    assert varying_parameters(STOPPING, FRICTION, constant) == []
    two = Trials(torch.tensor([[1.0, 2.0], [2.0, 2.0]]), torch.zeros(2, 2))
    found = varying_parameters(STOPPING, FRICTION, two)
    by = {e.name.partition(" by ")[2] for e in found}
    assert (len(found), by) == (4, {"action 1", "trial"})
