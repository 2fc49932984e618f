"""Noise of which the size is unknown in each channel: fits tell the ratio."""

import pytest
import torch
from torch.distributions import Independent, Uniform

from sbi_active import AutocorrelatedNoise, SimulatorModel
from sbi_active.criticism import Criticism, Effect, Trials
from tests.effects import half


def gliding(theta, action, *, times, drag=0.0):
    """Place in m and speed in mm/s of what is pushed off, and slows down."""
    drag = torch.as_tensor(drag, dtype=theta.dtype).reshape(-1, 1)
    speed = action * torch.exp(-theta * times) / (1 + drag * action * times)
    return torch.stack([speed * times, 1e3 * speed], -1)


@pytest.mark.parametrize("drag", [0.0, 0.6])
def test_the_loop_names_an_effect_beside_errors_of_unknown_size_in_two_units(drag):
    times = torch.linspace(0.1, 3, 15, dtype=torch.float64)
    gen = torch.Generator().manual_seed(4)
    action = torch.linspace(0.5, 2, 6, dtype=torch.float64)[:, None]
    theta = torch.full((6, 1), 0.5, dtype=torch.float64)
    error = torch.randn(6, 15, 2, generator=gen, dtype=torch.float64)
    x = gliding(theta, action, times=times, drag=drag)
    x = x + error * torch.tensor([0.02, 15.0], dtype=torch.float64)
    sizes = {"sd": [(1e-3, 1.0), (1.0, 1e3)], "correlation_time": (0.02, 3.0)}
    noise = AutocorrelatedNoise.unknown(**sizes)
    model = SimulatorModel(gliding, noise=noise, sample_times=times)
    prior = Independent(Uniform(torch.zeros(1), 2 * torch.ones(1)), 1)
    trials = Trials(action, x, sample_times=times)
    effects = [Effect.keyword("drag", prior=half(0.3))]
    tracing = Criticism(model, prior, trials, effects=effects, seed=0).trace()
    assert tracing.verdict == ("drag" if drag else "none")
    if drag:
        (phi,) = (e for e in tracing.estimates if e.name == "drag")
        assert abs(phi.mean - drag) < 4 * phi.sd
