"""Nuisances that are centered on the first samples of each trial."""

import warnings

import numpy as np
import pytest
import torch
from torch.distributions import HalfNormal, Independent, Normal

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Context, Criticism, Effect, Trials
from sbi_active.criticism.effects.first_samples import (
    start_from_first_samples,
    zero_from_first_samples,
)

SENSOR = 0.02
TIMES = torch.linspace(0.1, 2.0, 20).double()


def lines(num=400, seed=0):
    """Return motions with constant acceleration, their starts at time 0, and speeds."""
    rng = np.random.default_rng(seed)
    place, speed = torch.from_numpy(rng.normal(size=(2, num, 1)))
    x = place + speed * TIMES + SENSOR * torch.from_numpy(rng.normal(size=(num, 20)))
    trials = Trials(torch.arange(float(num)), x, sample_times=TIMES)
    return trials, place[:, 0], speed[:, 0]


def test_errors_of_the_center_are_those_that_the_width_says():
    trials, place, speed = lines()
    wanted = {"place": 0, "speed": (0, 1)}
    found, nuisance = start_from_first_samples(
        trials, wanted, within=0.55, sd=SENSOR, at=0.0, width=1.0
    )
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
    wanted = {"force": (0, 2), "angle": 1}
    found, nuisance = start_from_first_samples(
        trials, wanted, within=0.6, sd=[SENSOR, 10 * SENSOR], at=0.0
    )
    assert {k: float(v) for k, v in found.start.items()} == pytest.approx(
        {"load": 8.0, "force": 3.0, "angle": 1.0}
    )
    once = start_from_first_samples(
        trials, wanted, within=0.6, sd=[SENSOR, SENSOR], at=0.0
    )[1]
    ratio = nuisance.prior.stddev / once.prior.stddev
    assert ratio.tolist() == pytest.approx([1, 10])


def test_zeros_are_taken_from_x_and_are_left_by_the_sensor_alone():
    rng = np.random.default_rng(0)
    zero = torch.from_numpy(rng.normal(0, 50, (300, 1, 1)))
    push = torch.cat([torch.zeros(5), torch.ones(15)]).double()[None, :, None]
    noise = SENSOR * torch.from_numpy(rng.normal(size=(300, 20, 1)))
    other = torch.ones(300, 20, 1)
    x = torch.cat([other, zero + push + noise], -1)
    trials = Trials(torch.arange(300.0), x, sample_times=TIMES)
    found, nuisance = zero_from_first_samples(
        trials, within=0.45, sd=SENSOR, channels=[1], width=1.0
    )
    left = (found.x[:, 5:, 1] - 1).mean(1)
    sd = float(nuisance.prior.stddev)
    assert sd == pytest.approx(SENSOR / 5**0.5)
    expected = (sd**2 + SENSOR**2 / 15) ** 0.5
    assert float(left.std()) == pytest.approx(expected, rel=0.15)
    assert torch.equal(found.x[..., 0], trials.x[..., 0])
    assert float(trials.x[0, 0, 1]) == pytest.approx(float(x[0, 0, 1]))
    context = Context(torch.zeros(300))
    changed = nuisance.apply(found.x, torch.ones(300, 1), found.action, context)
    assert torch.equal(changed[..., 0], found.x[..., 0])
    assert torch.allclose(changed[..., 1], found.x[..., 1] + 1)


def level(theta, action, *, start=None, drag=0.0):
    """Return x' = -theta x - drag x |x| from a start, (n, k)."""
    x = torch.zeros(len(theta)).double() if start is None else start["level"].double()
    found, dt = [], 0.025
    for i in range(80):
        x = x + dt * (action[:, 0] - theta[:, 0] * x - drag * x * x.abs())
        if i % 4 == 3:
            found.append(x)
    return torch.stack(found, 1).to(theta.dtype)


def test_a_loop_finds_what_a_start_at_rest_would_hide():
    rng = np.random.default_rng(0)
    action = torch.from_numpy(rng.uniform(1, 4, (10, 1)))
    start = {"level": torch.from_numpy(rng.normal(1.5, 0.5, 10))}
    theta = torch.full((10, 1), 2.3).double()
    x = level(theta, action, start=start, drag=0.6)
    x = x + SENSOR * torch.from_numpy(rng.normal(size=x.shape))
    raw = Trials(action, x, sample_times=TIMES)
    trials, nuisance = start_from_first_samples(
        raw, {"level": 0}, within=0.35, sd=SENSOR, at=0.0
    )
    drag = Effect.keyword("drag", prior=HalfNormal(1.0))
    model = SimulatorModel(level, noise=GaussianNoise(SENSOR), sample_times=TIMES)
    prior = Independent(Normal(torch.tensor([2.0]), torch.tensor([0.7])), 1)
    found = Criticism(model, prior, trials, effects=[nuisance, drag], seed=0)
    tracing = found.trace()
    assert tracing.verdict == "drag"
    draws = tracing.evidences["drag"].draws
    z = (draws.mean(0) - [2.3, 0.6]) / draws.std(0)
    assert (np.abs(z) < 3.5).all()


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
