"""Two effects that are alike near their null, and further off may not be."""

import torch
from torch.distributions import HalfNormal, Independent, LogNormal, Normal

from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.criticism import Criticism, Effect, Trials

TIMES = torch.linspace(0, 3, 31)
FREQUENCIES = DiscreteActions(torch.linspace(0.5, 3.0, 6))
SCALE = torch.tensor([0.2])
PRIOR = LogNormal(torch.zeros(1), torch.tensor([0.3]))


def respond(theta, action, *, delay=0.0, lag=0.0, clock=0.0, unused=0.0):
    """Return the answer to a sine of frequency action, late by a delay or by a lag."""
    late, tau, early = (
        (torch.as_tensor(v) + torch.zeros(len(theta))).double()[:, None]
        for v in (delay, lag, clock)
    )
    w = action.double()
    phase = w * (TIMES - late + early.expm1()) - torch.atan(w * tau)
    size = theta.double() / (1 + (w * tau) ** 2).sqrt()
    return (size * torch.sin(phase)).to(theta.dtype)


def normal(scale):
    return Independent(Normal(torch.zeros(1), scale), 1)


LATE = {
    "delay": Independent(HalfNormal(SCALE), 1),
    "lag": Independent(HalfNormal(SCALE), 1),
    "clock": normal(SCALE),
}


#: Late, and with a second strength that shows nowhere.
TWO = Effect.keyword(
    "two",
    *("delay", "unused"),
    prior=Independent(HalfNormal(torch.tensor([0.2, 1.0])), 1),
)


def groups(*names):
    model = SimulatorModel(respond, noise=GaussianNoise(0.02), sample_times=TIMES)
    gen = torch.Generator().manual_seed(0)
    action = FREQUENCIES.values
    x = respond(torch.ones(6, 1), action) + 0.02 * torch.randn(6, 31, generator=gen)
    effects = [
        n if isinstance(n, Effect) else Effect.keyword(n, prior=LATE[n]) for n in names
    ]
    prior = Independent(PRIOR, 1)
    trials = Trials(action, x, sample_times=TIMES)
    return Criticism(
        model, prior, trials, effects=effects, actions=FREQUENCIES
    ).equivalent()


def test_a_delay_is_a_lag_near_zero_and_not_beyond():
    """Both have the derivative of x, and a lag is smaller at high frequencies."""
    assert groups("delay", "lag") == ()


def test_a_delay_is_a_clock_of_another_scale_at_any_size():
    """1 - exp(-t) takes the place of a delay t."""
    assert groups("delay", "clock") == (frozenset({"delay", "clock"}),)


def test_of_three_the_two_are_left_that_are_alike_everywhere():
    assert groups("lag", "delay", "clock") == (frozenset({"delay", "clock"}),)


def test_effects_may_have_strengths_of_other_numbers():
    assert groups(TWO, "clock") == (frozenset({"two", "clock"}),)
    assert groups("lag", TWO) == ()
