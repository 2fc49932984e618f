r"""Two tanks, one above the other; a pump fills the upper, a sensor reads the lower.

.. math::
    A_1 \dot h_1 = \kappa\, u(t) - c_1 \sqrt{h_1}, \qquad
    A_2 \dot h_2 = c_1 \sqrt{h_1} - c_2 \sqrt{h_2},

from known levels, the upper tank's area being known. The voltage steps from one value
to another at .45 of the trial. An action is (first voltage, second voltage, upper
level, lower level), and theta is (c_1, c_2, kappa, A_2) in cm and s.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from benchmarks.criticism.worlds.world import half_normal, normal
from benchmarks.misfit.machines.joint import read, row
from benchmarks.misfit.machines.machine import (
    Form,
    Hidden,
    Machine,
    box,
    sample_times,
    sensor_effects,
    uniform_rows,
)
from sbi_active.criticism import Effect

DURATION, NUM_STEPS = 240.0, 120  # s
AREA = 28.0  # cm^2, of the upper tank
SWITCH = 0.45
BRIM = 12.0  # cm, from which the upper tank spills into the lower one
LAMINAR = 0.1  # cm, below which Torricelli's law ends
NOISE_SD = 0.05  # cm
#: Inflows of the lower tank as functions of both levels, in units of 10 cm from 10 cm.
FORMS = {
    "siphon": Form(lambda h, k: -torch.sigmoid((k - 0.1) / 0.1), signed=False),
    "vortex": Form(lambda h, k: torch.tanh(3 * h)),
}
UNSEEN_FORMS = {
    "baffle": Form(lambda h, k: torch.exp(-0.5 * (k / 0.3) ** 2)),
    "ripple": Form(lambda h, k: torch.sin(4 * h)),
}


def fill(
    theta: Tensor,
    action: Tensor,
    *,
    times: Tensor,
    sensor_lag: Tensor | float = 0.0,
    pump_lag: Tensor | float = 0.0,
    pump_curve: Tensor | float = 0.0,
    leak: Tensor | float = 0.0,
    spill: Tensor | float = 0.0,
    trend: Tensor | float = 0.0,
    hidden: Hidden | None = None,
) -> Tensor:
    """Return the level of the lower tank.

    Every effect is a number, or one a row.

    Args:
        theta: Shape (n, 4).
        action: Shape (n, 4).
        times: s, shape (k,) or (n, k).
        sensor_lag: By which the sensor is late, s.
        pump_lag: Time constant of the pump, s.
        pump_curve: Relative change of the flow a volt above 4 V.
        leak: Outflow of the lower tank in proportion to its level, cm^2/s.
        spill: Flow from the upper to the lower tank above 12 cm, cm^2/s.
        trend: Relative loss of the pump at the trial's end, in proportion to the time.
        hidden: What nobody declared: "force", a flow into the lower tank in cm^3/s,
            "wander upper" and "wander lower", relative, by step, and strengths of
            forms, cm^3/s.

    Returns:
        Shape (n, k), cm.
    """
    upper, lower, gain, area = theta.double().unbind(1)
    first, second, level, below = action.double().unbind(1)
    hidden, step = hidden or {}, DURATION / NUM_STEPS
    lost, over, late = (row(part, theta) for part in (leak, spill, pump_lag))
    curve, tired = row(pump_curve, theta), row(trend, theta)
    before, after = (gain * u * (1 + curve * (u - 4)) for u in (first, second))
    known = {**FORMS, **UNSEEN_FORMS}
    forms: list[tuple[Callable[[Tensor, Tensor], Tensor], Tensor]] = [
        (known[name.removeprefix("form ")].apply, strength)
        for name, strength in hidden.items()
        if name.startswith("form ")
    ]
    outside = hidden.get("force")
    loose, slack = hidden.get("wander upper"), hidden.get("wander lower")

    def flows(h: Tensor, b: Tensor, pump: Tensor, k: int) -> tuple[Tensor, Tensor]:
        c = upper if loose is None else upper * (1 + loose[:, k])
        down = c * _root(h) + over * (h - BRIM).clamp(min=0)
        c = lower if slack is None else lower * (1 + slack[:, k])
        net = down - c * _root(b) - lost * b
        if outside is not None:
            net = net + outside[:, k]
        for apply, strength in forms:
            net = net + strength * apply(h / 10 - 1, b / 10 - 1)
        return (pump - down) / AREA, net / area

    path, speed = [below], []
    for k in range(NUM_STEPS):
        share = _risen(k * step - SWITCH * DURATION, step, late)
        pump = before + (after - before) * share
        pump = pump * (1 - tired * ((k + 0.5) / NUM_STEPS))
        dh, db = flows(level, below, pump, k)
        speed.append(db)
        dh, db = flows(level + 0.5 * step * dh, below + 0.5 * step * db, pump, k)
        level, below = level + step * dh, below + step * db
        path.append(below)
    speed.append(db)
    x = read(
        torch.stack(path, 1), torch.stack(speed, 1), times, step=step, lag=sensor_lag
    )
    return x.to(theta.dtype)


def _root(level: Tensor) -> Tensor:
    """Return the square root, linear where the flow is laminar."""
    h = level.clamp(min=0)
    return h / torch.sqrt(h + LAMINAR)


def _risen(since: float, step: float, late: Tensor) -> Tensor:
    """Return how much of a step the lagging pump has done, mean over a time step."""
    a, b = max(since, 0.0), max(since + step, 0.0)
    tau = late.clamp(min=1e-9)
    return (b - a) / step - tau / step * (torch.exp(-a / tau) - torch.exp(-b / tau))


def make_tanks(num_trials: int, num_samples: int) -> Machine:
    """Return the tanks.

    Args:
        num_trials: To fit.
        num_samples: A trial.
    """
    times = sample_times(DURATION, num_samples)
    return Machine(
        name="tanks",
        fn=partial(fill, times=times),
        prior=box((2.5, 5.0), (2.5, 5.0), (2.0, 4.0), (15.0, 50.0)),
        parameter_names=("upper outlet", "lower outlet", "pump gain", "lower area"),
        draw_actions=lambda num: uniform_rows(
            num, (2.0, 5.0), (2.0, 5.0), (3.0, 20.0), (3.0, 20.0)
        ),
        noise_sd=NOISE_SD,
        times=times,
        num_trials=num_trials,
        library=[
            Effect.keyword(
                "sensor lag", prior=half_normal(5.0), units="s", family="observation"
            ),
            *sensor_effects(bias=0.25, gain=0.1, drift=0.05),
            Effect.keyword(
                "pump lag", prior=half_normal(8.0), units="s", family="action"
            ),
            Effect.keyword(
                "pump curve", prior=normal(0.04), units="1/V", family="action"
            ),
            Effect.keyword("leak", prior=half_normal(0.06), units="cm^2/s"),
            Effect.keyword("spill", prior=half_normal(0.2), units="cm^2/s"),
            Effect.keyword("trend", prior=normal(0.1)),
        ],
        fast=("sensor lag", "pump lag"),
        slow=("bias", "drift", "trend"),
        forms=[*FORMS],
        unseen_forms=[*UNSEEN_FORMS],
        unsigned_forms=["siphon"],
        wandering=("wander upper", "wander lower"),
        num_steps=NUM_STEPS,
    )
