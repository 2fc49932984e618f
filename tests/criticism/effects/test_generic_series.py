"""Generic effects of recordings: which there are, and that a loop finds them."""

import pytest
import torch
from sbi.utils import BoxUniform

from sbi_active import GaussianNoise, SimulatorModel
from sbi_active.criticism import Criticism, Trials, generic_effects
from tests.criticism.motor_world import MODEL, PRIOR, measured


@pytest.mark.parametrize(("name", "size"), [("input delay", 0.07), ("backlash", 0.5)])
def test_what_an_actuator_does_is_found(name, size):
    given = {"num": 5, "held_out": 0}
    rivals = {"input gain", "input lag", "input delay", "backlash"}
    effects = generic_effects(MODEL, measured(0, {}, **given), prior=PRIOR)
    effects = [effect for effect in effects if effect.name in rivals]
    trials = measured(0, {name: size}, **given, library=effects)
    tracing = Criticism(MODEL, PRIOR, trials, effects=effects).trace()
    named = {part for g in tracing.equivalent if name in g for part in g}
    assert tracing.verdict in {name} | named
    for other in ("input lag", name):
        assert not any({"none", other} <= group for group in tracing.equivalent)


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
    times, truth = torch.arange(20).double(), torch.tensor([[2.0]]).double()
    x = two_sensors(truth, None, inputs={"u": u}, times=times[None])
    x = x + torch.tensor([0.05, 0.2]) * torch.randn(x.shape, generator=gen)
    x[..., 1] += 0.6
    given = {"sample_times": times, "inputs": {"u": u}}
    trials = Trials(None, x, channel_labels=["angle [rad]", "rate [rad/s]"], **given)
    effects = {e.name: e for e in generic_effects(model, trials, prior=prior)}
    assert "bias" not in effects
    sd = [effects[f"{n} bias"].declared_draws().std() for n in ("angle", "rate")]
    assert 3 < float(sd[1] / sd[0]) < 5
    some = [e for n, e in effects.items() if n.endswith(("bias", "sensor lag"))]
    assert Criticism(model, prior, trials, effects=some).trace().verdict == "rate bias"
