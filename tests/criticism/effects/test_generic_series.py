"""Generic effects of recordings: which there are, and that a loop finds them."""

import pickle

import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Context, Criticism, Trials, generic_effects
from sbi_active.criticism.effects.changes import delayed_input, played
from tests.criticism.motor_world import GRID, MODEL, NOISE, PRIOR, measured, speed

ACTUATOR = {
    "input gain",
    "input offset",
    "input saturation",
    "dead zone",
    "input delay",
    "input lag",
    "backlash",
}
SENSOR = {
    "bias",
    "sensor gain",
    "drift",
    "sensor saturation",
    "drift in time",
    "sensor delay",
    "sensor lag",
    "sensor quantum",
}


def test_a_recording_has_an_actuator_and_a_sensor():
    effects = generic_effects(MODEL, measured(0, {}), prior=PRIOR)
    assert {e.name for e in effects} == ACTUATOR | SENSOR
    assert {e.name for e in effects if e.hook == "input"} == ACTUATOR
    assert not [e for e in effects if e.hook == "action"]


def test_effects_travel_to_other_processes():
    x = torch.rand(4, 19).double()
    times = torch.linspace(0, 1, 19).double()
    context = Context(torch.arange(4), times)
    for effect in generic_effects(MODEL, measured(0, {}), prior=PRIOR):
        there = pickle.loads(pickle.dumps(effect))
        if effect.hook == "observation":
            rows = (x, effect.declared_draws()[:4], x, context)
            assert torch.equal(there.apply(*rows), effect.apply(*rows))


def distorted(change):
    """Trials of a motor whose voltage is changed before it acts."""
    trials = measured(0, {}, num=5, held_out=0)
    real = {"voltage": change(trials.inputs["voltage"])}
    rows = len(trials)
    x = speed(
        torch.tensor([[3.0, 0.3]]).double().expand(rows, -1),
        trials.action,
        inputs=real,
        times=trials.sample_times.expand(rows, -1),
        input_times=GRID,
        start=trials.start,
    )
    gen = torch.Generator().manual_seed(5)
    x = x + NOISE * torch.randn(x.shape, generator=gen).double()
    return Trials(
        None,
        x,
        sample_times=trials.sample_times,
        inputs=trials.inputs,
        input_times=GRID,
        start=trials.start,
    )


@pytest.mark.parametrize(
    ("name", "change"),
    [
        (
            "input delay",
            lambda u: delayed_input(u, torch.full((len(u), 1), 0.07), 0.02),
        ),
        ("backlash", lambda u: played(u, torch.full((len(u), 1), 0.5).double())),
    ],
)
def test_what_an_actuator_does_is_found(name, change):
    trials = distorted(change)
    effects = generic_effects(MODEL, trials, prior=PRIOR)
    rivals = {"input gain", "input offset", "input delay", "input lag", "backlash"}
    effects = [effect for effect in effects if effect.name in rivals]
    assert len(effects) == len(rivals)
    loop = Criticism(MODEL, PRIOR, trials, effects=effects)
    named = {
        part for group in loop.trace().equivalent if name in group for part in group
    }
    assert loop.trace().verdict == name or loop.trace().verdict in named
    assert not any({"none", "input lag"} <= group for group in loop.trace().equivalent)
    assert not any({"none", name} <= group for group in loop.trace().equivalent)


def two_sensors(theta, action, *, inputs, times):
    """An angle and its rate, which follow the input at once."""
    u = inputs["u"]
    x = torch.stack([theta * u, 10 * theta * u.diff(dim=1, prepend=u[:, :1])], -1)
    return x[:, : times.shape[1]]


def test_sensors_have_effects_each_for_itself():
    prior = BoxUniform(torch.ones(1), 3 * torch.ones(1))
    model = SimulatorModel(two_sensors, noise=GaussianNoise([0.05, 0.2]))
    gen = torch.Generator().manual_seed(0)
    u = torch.randn(6, 20, generator=gen).double().cumsum(1)
    times = torch.arange(20).double()
    x = two_sensors(
        torch.tensor([[2.0]]).double(), None, inputs={"u": u}, times=times[None]
    )
    x = x + torch.tensor([0.05, 0.2]) * torch.randn(x.shape, generator=gen)
    x[..., 1] += 0.6
    trials = Trials(
        None,
        x,
        sample_times=times,
        inputs={"u": u},
        channel_labels=["angle [rad]", "rate [rad/s]"],
    )
    effects = {e.name: e for e in generic_effects(model, trials, prior=prior)}
    assert {"angle bias", "rate bias", "rate sensor lag"} <= {*effects}
    assert "bias" not in effects
    sd = [effects[f"{n} bias"].declared_draws().std() for n in ("angle", "rate")]
    assert 3 < float(sd[1] / sd[0]) < 5
    some = [e for n, e in effects.items() if n.endswith(("bias", "sensor lag"))]
    loop = Criticism(model, prior, trials, effects=some)
    assert loop.trace().verdict == "rate bias"
