"""Effects without a derivative at their null are not taken for none."""

import pytest
import torch
from sbi.utils import BoxUniform
from torch.distributions import HalfNormal, Independent, Normal

from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.criticism import Criticism, Effect, Trials

TIMES = torch.linspace(0, 1, 21)
STEP = 0.05
PRIOR = BoxUniform(torch.tensor([0.2, 0.5]), torch.tensor([1.5, 4.0]))
ACTIONS = DiscreteActions(torch.linspace(0.5, 2.0, 6))
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


def half(scale):
    return Independent(HalfNormal(torch.tensor([scale])), 1)


def normal(scale):
    return Independent(Normal(torch.zeros(1), torch.tensor([scale])), 1)


def effect(apply, prior, hook="observation"):
    return Effect(apply.__name__, hook=hook, prior=prior, null=0.0, apply=apply)


def loop(*effects, x=None, smooth=True):
    fn = (
        swing
        if smooth
        else (lambda theta, action: swing(theta, action).round(decimals=2))
    )
    model = SimulatorModel(fn, noise=GaussianNoise(0.05), sample_times=TIMES)
    action = ACTIONS.values[[0, 2, 4, 1, 5, 3]]
    x = swing(TRUE, action) if x is None else x
    gen = torch.Generator().manual_seed(0)
    x = x + 0.05 * torch.randn(x.shape, generator=gen)
    trials = Trials(action, x, sample_times=TIMES)
    return Criticism(model, PRIOR, trials, effects=effects, actions=ACTIONS)


FLAT = [
    effect(held, half(2 * STEP)),
    effect(rounded, half(0.5)),
    effect(dead, half(0.8), "action"),
]


@pytest.mark.parametrize(
    ("flat", "smooth"), [(FLAT[0], True), (FLAT[1], False), (FLAT[2], True)]
)
def test_what_is_flat_at_its_null_is_not_none(flat, smooth):
    assert loop(flat, smooth=smooth).equivalent() == ()


@pytest.mark.parametrize(
    "hidden",
    [effect(late, normal(1.0)), effect(scaled, normal(0.3))],
    ids=lambda e: e.name,
)
def test_what_shows_nowhere_or_is_a_parameter_is_none(hidden):
    assert loop(hidden).equivalent() == (frozenset({"none", hidden.name}),)


def test_a_lag_that_is_held_over_steps_raises_the_alarm_and_is_named():
    action = ACTIONS.values[[0, 2, 4, 1, 5, 3]]
    x = held(swing(TRUE, action), torch.full((6, 1), 3 * STEP), action, None)
    criticism = loop(*FLAT, x=x)
    assert criticism.detect().by_evidence
    report = criticism.report(evaluate=False, plan=False)
    assert report.verdict == "held"
    assert "no permitted action tells it from" not in str(report).splitlines()[0]
