"""A driven oscillator with effects, and what nobody declared, for tests of misfit."""

import torch
from torch import Tensor
from torch.distributions import HalfNormal, Independent, Normal

from sbi_active import SimulatorModel
from sbi_active.criticism import Effect, Trials

NUM_TRIALS, NUM_SAMPLES = 8, 20
TIMES = torch.linspace(0.2, 4.0, NUM_SAMPLES, dtype=torch.float64)
SENSOR = 0.01
PRIOR = Independent(Normal(torch.tensor([2.0, 0.3]), torch.tensor([0.5, 0.1])), 1)
EFFECTS = [
    Effect.keyword("cubic", prior=Normal(0.0, 1.0)),
    Effect.keyword("friction", prior=HalfNormal(0.3)),
    Effect.keyword("lag", prior=HalfNormal(0.1)),
    Effect.keyword("bias", prior=Normal(0.0, 0.05)),
]


def oscillate(
    theta, action, *, cubic=0.0, friction=0.0, lag=0.0, bias=0.0, hidden=0.0, start=0.0
):
    """Return positions at the sample times of x'' = -k x - c x' + u sin 2t, (n, k)."""
    k, c = theta.T.double()
    u = action[:, 0].double()
    x, v = start + torch.zeros_like(k), torch.zeros_like(k)
    dt, found = 0.2, []
    for i in range(NUM_SAMPLES):
        drive = u * torch.sin(torch.tensor(2 * dt * i, dtype=torch.float64))
        a = drive - k * x - c * v - cubic * x**3 - friction * torch.tanh(v / 0.05)
        v = v + dt * (a + hidden * torch.cos(3 * x) * x)
        x = x + dt * v
        found.append(x - lag * v + bias)
    return torch.stack(found, 1).to(theta.dtype)


MODEL = SimulatorModel(oscillate, noise=SENSOR, sample_times=TIMES)
ACTION = torch.linspace(0.5, 2.0, NUM_TRIALS, dtype=torch.float64)[:, None]


def trials(seed: int = 0, *, action: Tensor = ACTION, **effects: float) -> Trials:
    """Return measured trials of a machine with some effects."""
    theta = torch.tensor([[2.2, 0.25]], dtype=torch.float64).expand(len(action), -1)
    x = oscillate(theta, action, **effects)
    gen = torch.Generator().manual_seed(seed)
    x = x + SENSOR * torch.randn(x.shape, generator=gen, dtype=torch.float64)
    return Trials(action, x, sample_times=TIMES)
