r"""A mass on a spring, driven by a sine, with a payload that is known.

.. math::
    (m + p)\, \ddot q = a \sin(\omega t) - k (q - r) - c\, \dot q,

released at rest at a known place. An action is (a in N, omega in rad/s, p in kg, place
in m), and theta is (m in kg, k in N/m, c in N s/m, r in m).
"""

from __future__ import annotations

import math
from functools import partial

import torch
from torch import Tensor

from benchmarks.criticism.worlds.world import half_normal, normal
from benchmarks.misfit.machines.joint import (
    FORMS,
    UNSEEN_FORMS,
    integrate,
    of_state,
    read,
    row,
)
from benchmarks.misfit.machines.machine import (
    Hidden,
    Machine,
    box,
    sensor_effects,
    signs,
    uniform_rows,
)
from sbi_active.criticism import Effect

__all__ = ["make_spring", "oscillate"]

DURATION, NUM_STEPS = 4.0, 160  # s
SCALE = 0.35, 1.5  # m, m/s; of undeclared forces
NOISE_SD = 0.01  # m


def oscillate(
    theta: Tensor,
    action: Tensor,
    *,
    times: Tensor,
    sensor_lag: Tensor | float = 0.0,
    drive_gain: Tensor | float = 0.0,
    coulomb: Tensor | float = 0.0,
    quadratic: Tensor | float = 0.0,
    cubic: Tensor | float = 0.0,
    trend: Tensor | float = 0.0,
    hidden: Hidden | None = None,
) -> Tensor:
    """Return the place of the mass.

    Every effect is a number, or one a row.

    Args:
        theta: Shape (n, 4).
        action: Shape (n, 4).
        times: s, shape (k,) or (n, k).
        sensor_lag: By which the sensor is late, s.
        drive_gain: Relative error of the driving force.
        coulomb: Dry friction, N.
        quadratic: Drag, N s^2/m^2.
        cubic: Of the spring, N/m^3.
        trend: Force that grows in proportion to the time, at its end, N.
        hidden: What nobody declared: "force" in N and "wander damping" and
            "wander stiffness", relative, by step, and strengths of forms, N.

    Returns:
        Shape (n, k), m.
    """
    mass, stiffness, damping, rest = theta.double().unbind(1)
    amplitude, frequency, payload, start = action.double().unbind(1)
    hidden, step = hidden or {}, DURATION / NUM_STEPS
    amplitude = amplitude * (1 + row(drive_gain, theta))
    stiff, ramp = row(cubic, theta), row(trend, theta)
    forms = of_state(hidden, SCALE)
    outside, loose = hidden.get("force"), hidden.get("wander stiffness")
    is_cubic, has_trend = bool((stiff != 0).any()), bool((ramp != 0).any())
    middles = step * (torch.arange(NUM_STEPS, dtype=torch.float64) + 0.5)
    drive = amplitude[:, None] * torch.sin(frequency[:, None] * middles)
    drive = drive.T.contiguous()

    def force(q: Tensor, v: Tensor, k: int) -> Tensor:
        pull = stiffness * (q - rest)
        total = drive[k] - (pull if loose is None else pull * (1 + loose[:, k]))
        if is_cubic:
            total = total - stiff * q**3
        if has_trend:
            total = total + ramp * ((k + 0.5) / NUM_STEPS)
        if outside is not None:
            total = total + outside[:, k]
        for apply, strength in forms:
            total = total + strength * apply(q, v)
        return total

    path, speed = integrate(
        start,
        mass + payload,
        damping,
        force,
        step=step,
        num_steps=NUM_STEPS,
        coulomb=row(coulomb, theta),
        quadratic=row(quadratic, theta),
        wander=hidden.get("wander damping"),
    )
    return read(path, speed, times, step=step, lag=sensor_lag).to(theta.dtype)


def make_spring(num_trials: int, num_samples: int) -> Machine:
    """Return the driven mass.

    Args:
        num_trials: To fit.
        num_samples: A trial.
    """
    times = torch.linspace(0, DURATION, num_samples + 1, dtype=torch.float64)[1:]
    dynamics = {
        "coulomb": ("Coulomb", half_normal(0.6), "N"),
        "quadratic": ("quadratic drag", half_normal(0.5), "N s^2/m^2"),
        "cubic": ("cubic spring", half_normal(20.0), "N/m^3"),
        "trend": ("trend", normal(1.0), "N"),
    }
    return Machine(
        name="spring",
        fn=partial(oscillate, times=times),
        prior=box((0.5, 2.0), (8.0, 45.0), (0.15, 1.5), (-0.1, 0.1)),
        parameter_names=("mass", "stiffness", "damping", "rest"),
        draw_actions=draw_actions,
        noise_sd=NOISE_SD,
        times=times,
        num_trials=num_trials,
        library=[
            Effect.keyword(
                "sensor lag", prior=half_normal(0.08), units="s", family="observation"
            ),
            *sensor_effects(bias=0.05, gain=0.1, drift=0.01),
            Effect.keyword("drive gain", prior=normal(0.1), family="action"),
            *[
                Effect.keyword(name, keyword, prior=prior, units=units)
                for keyword, (name, prior, units) in dynamics.items()
            ],
        ],
        fast=("sensor lag", "Coulomb"),
        slow=("bias", "drift", "trend"),
        forms=[*FORMS],
        unseen_forms=[*UNSEEN_FORMS],
        unsigned_forms=[
            n for n, f in {**FORMS, **UNSEEN_FORMS}.items() if not f.signed
        ],
        wandering=("wander damping", "wander stiffness"),
        num_steps=NUM_STEPS,
    )


def draw_actions(num: int) -> Tensor:
    """Return forces, frequencies, payloads and places, shape (num, 4)."""
    action = uniform_rows(
        num, (1.0, 6.0), (0.6 * math.pi, 2.2 * math.pi), (0.0, 1.5), (-0.4, 0.4)
    )
    action[:, 0] *= signs(num)
    return action
