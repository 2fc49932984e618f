"""A DC motor that follows a recorded voltage, and what it may lack."""

import torch
from sbi.utils import BoxUniform
from torch.distributions import HalfNormal

from sbi_active import SimulatorModel
from sbi_active.criticism import AugmentedSimulator, Context, Effect, Trials
from tests.effects import effect, half, normal

NOISE = 0.05  # rad/s
STEP = 0.02  # s
GRID = STEP * torch.arange(101).double()
PRIOR = BoxUniform(torch.tensor([1.0, 0.1]), torch.tensor([6.0, 1.0]))


def speed(theta, action, *, inputs, times, input_times, start, coulomb=0.0):
    """tau w' = k u - w - c sign(w), at times; no row depends on another."""
    voltage = inputs["voltage"]
    gain, tau = theta.unbind(1)
    keep = torch.exp(-(input_times[1] - input_times[0]) / tau)
    w, found = start["speed"], []
    for u in voltage.unbind(1):
        found.append(w)
        torque = gain * u
        free = keep * w + (1 - keep) * torque
        # Friction cannot turn the motor around.
        shift = (1 - keep) * torch.as_tensor(coulomb).to(w)
        w = free.sign() * (free.abs() - shift).clamp(min=0)
    series = torch.stack(found, 1)
    at = ((times - input_times[0]) / (input_times[1] - input_times[0])).clamp(min=0)
    low = at.long().clamp(max=series.shape[1] - 2)
    part = at - low
    return (1 - part) * series.gather(1, low) + part * series.gather(1, low + 1)


MODEL = SimulatorModel(speed, noise=NOISE, parameter_names=["gain", "tau"])


def _voltage(change):
    def apply(value, phi, action, context):
        return {**value, "voltage": change(value["voltage"], phi)}

    return apply


DEAD_ZONE = effect(
    "dead zone",
    hook="input",
    prior=half(0.2),
    apply=_voltage(lambda u, phi: u.sign() * (u.abs() - phi).clamp(min=0)),
)
SHIFTED = _voltage(lambda u, phi: u + phi)
OFFSET = effect("voltage offset", hook="input", prior=normal(0.2), apply=SHIFTED)
BIAS = effect(prior=normal(0.3))
COULOMB = Effect.keyword("coulomb", prior=HalfNormal(0.5))
LIBRARY = [DEAD_ZONE, OFFSET, BIAS, COULOMB]


def played(num, seed):
    """Random steps of the voltage, one every .2 s, shape (num, 101)."""
    gen = torch.Generator().manual_seed(seed)
    levels = 2 * torch.rand(num, 11, generator=gen).double() - 1
    return levels.repeat_interleave(10, 1)[:, : len(GRID)]


def measured(seed, phi, *, num=8, held_out=2, library=LIBRARY):
    """Trials of a motor with some effects, sampled off the voltage's grid."""
    total = num + held_out
    voltage = played(total, seed)
    start = {"speed": torch.linspace(-1, 1, total).double()}
    times = 0.05 + 0.1 * torch.arange(19).double()
    real = AugmentedSimulator(MODEL, library)
    x = real.evaluate(
        torch.tensor([[3.0, 0.3]]).double().expand(total, -1),
        {k: torch.full((total, 1), v).double() for k, v in phi.items()},
        torch.zeros(total, 1).double(),
        context=Context(torch.arange(total), times, {"voltage": voltage}, GRID, start),
    )
    gen = torch.Generator().manual_seed(seed + 1)
    x = x + NOISE * torch.randn(x.shape, generator=gen).double()
    return Trials(
        None,
        x,
        role=["fit"] * num + ["held out"] * held_out,
        sample_times=times,
        inputs={"voltage": voltage},
        input_times=GRID,
        start=start,
    )
