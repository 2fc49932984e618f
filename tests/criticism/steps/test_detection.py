"""Alarms, and effects that no permitted action tells apart."""

import pytest
import torch
from sbi.utils import BoxUniform
from scipy.stats import kstest
from torch.distributions import HalfNormal, Independent, LogNormal

from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel, StudentTNoise
from sbi_active.criticism import Criticism, Effect, Trials
from sbi_active.criticism.steps.detection import LEVEL
from sbi_active.simulation import estimate_noise
from tests.criticism.steps import linear_world as world
from tests.effects import effect, half, normal, on_outcomes


def detected(x, noise=world.SENSOR):
    return world.judged(world.rivals(x, noise=noise)).detection


def test_the_chi_square_alone_raises_the_alarm_where_the_noise_is_known():
    signs = torch.tensor([1.0, -1.0] * 6)[:, None]  # no effect takes these up
    x = 0.8 * world.ACTION + 1.5 * world.NOISE * signs
    found = detected(x)
    assert found.p_value < LEVEL
    assert not found.by_evidence
    assert found.alarm
    repeats = 0.1 * torch.randn(6, 1, generator=torch.Generator().manual_seed(0))
    for noise in (estimate_noise(repeats), StudentTNoise(0.1, df=4.0)):
        assert detected(x, noise).level == 0.0


def test_the_chi_square_of_clean_data_is_one():
    bare = [world.rivals(world.measured(seed=k)).with_effects(()) for k in range(24)]
    p = [world.judged(some).detection.p_value for some in bare]
    assert kstest(p, "uniform").pvalue > 0.01


# Effects without a derivative at their null are not taken for none


TIMES = torch.linspace(0, 1, 21)
STEP = 0.05
SWINGS = BoxUniform(torch.tensor([0.2, 0.5]), torch.tensor([1.5, 4.0]))
SIZES = DiscreteActions(torch.linspace(0.5, 2.0, 6))
TRUE = torch.tensor([[0.8, 2.0]])


def swing(theta, action):
    """A swing whose size depends on theta in a bend."""
    return action * theta[:, :1].exp() * torch.sin(theta[:, 1:] * TIMES.to(theta))


def held(x, phi, action, context):
    """A lag that takes whole steps alone."""
    late = (phi[:, 0] / STEP).round().long()
    places = (torch.arange(x.shape[1]) - late[:, None]).clamp_min(0)
    return x.gather(1, places)


def rounded(x, phi, action, context):
    """A quantum: nothing where it is far below the last digit."""
    quantum = phi.clamp_min(1e-3)
    return torch.where(phi > 1e-3, (x / quantum).round() * quantum, x)


def dead(action, phi, commanded, context):
    """An actuator that stands still below its smallest action."""
    return torch.where(action.abs() < phi + 0.4, torch.zeros_like(action), action)


def late(x, phi, action, context):
    """What shows beyond all permitted actions alone."""
    return x + phi * (action > 3)


def scaled(x, phi, action, context):
    """What the first parameter does as well, at any size."""
    return x * phi.exp()


def loop(*effects, x=None, fn=swing):
    model = SimulatorModel(fn, noise=GaussianNoise(0.05), sample_times=TIMES)
    action = SIZES.values[[0, 2, 4, 1, 5, 3]]
    x = swing(TRUE, action) if x is None else x
    gen = torch.Generator().manual_seed(0)
    x = x + 0.05 * torch.randn(x.shape, generator=gen)
    trials = Trials(action, x, sample_times=TIMES)
    return Criticism(model, SWINGS, trials, effects=effects, actions=SIZES)


FLAT = [
    effect("held", apply=held, prior=half(2 * STEP)),
    effect("rounded", apply=rounded, prior=half(0.5)),
    effect("dead", apply=dead, prior=half(0.8), hook="action"),
]


@pytest.mark.parametrize("flat", FLAT, ids=lambda e: e.name)
def test_what_is_flat_at_its_null_is_not_none(flat):
    coarse = lambda theta, action: swing(theta, action).round(decimals=2)  # noqa: E731
    assert loop(flat, fn=coarse if flat.name == "rounded" else swing).equivalent() == ()


@pytest.mark.parametrize(
    "hidden", [on_outcomes("late", late), on_outcomes("scaled", scaled, 0.3)]
)
def test_what_shows_nowhere_or_is_a_parameter_is_none(hidden):
    assert loop(hidden).equivalent() == (frozenset({"none", hidden.name}),)


def test_a_lag_that_is_held_over_steps_raises_the_alarm_and_is_named():
    action = SIZES.values[[0, 2, 4, 1, 5, 3]]
    x = held(swing(TRUE, action), torch.full((6, 1), 3 * STEP), action, None)
    criticism = loop(*FLAT, x=x)
    assert criticism.detect().by_evidence
    assert criticism.trace().verdict == "held"
    assert not any("held" in group for group in criticism.trace().equivalent)


# Two effects that are alike near their null, and further off may not be


STAMPS = torch.linspace(0, 3, 31)
FREQUENCIES = DiscreteActions(torch.linspace(0.5, 3.0, 6))
GAIN = LogNormal(torch.zeros(1), torch.tensor([0.3]))


EFFECTS = {
    "delay": Effect.keyword("delay", prior=half(0.2)),
    "lag": Effect.keyword("lag", prior=half(0.2)),
    "clock": Effect.keyword("clock", prior=normal(0.2)),
    # Late, and with a second strength that shows nowhere.
    "two": Effect.keyword(
        *("two", "delay", "unused"),
        prior=Independent(HalfNormal(torch.tensor([0.2, 1.0])), 1),
    ),
}


def respond(theta, action, *, delay=0.0, lag=0.0, clock=0.0, unused=0.0):
    """Return the answer to a sine of frequency action, late by a delay or by a lag."""
    late, tau, early = (
        (torch.as_tensor(v) + torch.zeros(len(theta))).double()[:, None]
        for v in (delay, lag, clock)
    )
    w = action.double()
    phase = w * (STAMPS - late + early.expm1()) - torch.atan(w * tau)
    size = theta.double() / (1 + (w * tau) ** 2).sqrt()
    return (size * torch.sin(phase)).to(theta.dtype)


@pytest.mark.parametrize(
    ("names", "pair"),
    [
        # Both have the derivative of x, and a lag is smaller at high frequencies.
        (("delay", "lag"), None),
        (("lag", "two"), None),
        # 1 - exp(-t) takes the place of a delay t.
        (("delay", "clock"), ("delay", "clock")),
        (("lag", "delay", "clock"), ("delay", "clock")),
        (("two", "clock"), ("two", "clock")),
    ],
)
def test_effects_that_are_alike_near_zero_alone_are_told_apart(names, pair):
    model = SimulatorModel(respond, noise=GaussianNoise(0.02), sample_times=STAMPS)
    gen, action = torch.Generator().manual_seed(0), FREQUENCIES.values
    x = respond(torch.ones(6, 1), action) + 0.02 * torch.randn(6, 31, generator=gen)
    trials = Trials(action, x, sample_times=STAMPS)
    given = {"effects": [EFFECTS[n] for n in names], "actions": FREQUENCIES}
    found = Criticism(model, Independent(GAIN, 1), trials, **given).equivalent()
    assert found == (() if pair is None else (frozenset(pair),))
