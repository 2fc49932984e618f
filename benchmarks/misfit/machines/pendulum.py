r"""A pendulum with a torque motor and a payload that is known.

.. math::
    (m l^2 + J + p l^2)\, \ddot q = u(t) - (m + p)\, g\, l \sin q - b\, \dot q,

released at rest at a known angle. The motor pushes with the torque u from .2 to .5 of
the trial. An action is (angle in rad, torque in N m, payload p in kg), and theta is
(l in m, b in N m s/rad, m in kg, J in kg m^2). The payload makes all four visible.
"""

from __future__ import annotations

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

__all__ = ["make_pendulum", "swing"]

GRAVITY = 9.81  # m/s^2
DURATION, NUM_STEPS = 3.0, 120  # s
SCALE = 1.0, 4.0  # rad, rad/s; of undeclared forms
NOISE_SD = 0.01  # rad


def swing(
    theta: Tensor,
    action: Tensor,
    *,
    times: Tensor,
    sensor_lag: Tensor | float = 0.0,
    motor_gain: Tensor | float = 0.0,
    coulomb: Tensor | float = 0.0,
    quadratic: Tensor | float = 0.0,
    cubic: Tensor | float = 0.0,
    trend: Tensor | float = 0.0,
    hidden: Hidden | None = None,
) -> Tensor:
    """Return the angle of the pendulum.

    Every effect is a number, or one a row.

    Args:
        theta: Shape (n, 4).
        action: Shape (n, 3).
        times: s, shape (k,) or (n, k).
        sensor_lag: By which the sensor is late, s.
        motor_gain: Relative error of the torque.
        coulomb: Dry friction, N m.
        quadratic: Drag, N m s^2/rad^2.
        cubic: Spring, N m/rad^3.
        trend: Torque that grows in proportion to the time, at its end, N m.
        hidden: What nobody declared: "force" in N m and "wander damping" and
            "wander gravity", relative, by step, and strengths of forms, N m.

    Returns:
        Shape (n, k), rad.
    """
    length, damping, mass, armature = theta.double().unbind(1)
    angle, torque, payload = action.double().unbind(1)
    hidden, step = hidden or {}, DURATION / NUM_STEPS
    torque = torque * (1 + row(motor_gain, theta))
    weight = (mass + payload) * GRAVITY * length
    stiff, ramp = row(cubic, theta), row(trend, theta)
    forms = of_state(hidden, SCALE)
    outside, loose = hidden.get("force"), hidden.get("wander gravity")
    is_cubic, has_trend = bool((stiff != 0).any()), bool((ramp != 0).any())

    def force(q: Tensor, v: Tensor, k: int) -> Tensor:
        pull = weight * torch.sin(q)
        total = -pull if loose is None else -pull * (1 + loose[:, k])
        if 0.2 <= (k + 0.5) / NUM_STEPS < 0.5:
            total = total + torque
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
        angle,
        (mass + payload) * length**2 + armature,
        damping,
        force,
        step=step,
        num_steps=NUM_STEPS,
        coulomb=row(coulomb, theta),
        quadratic=row(quadratic, theta),
        wander=hidden.get("wander damping"),
    )
    return read(path, speed, times, step=step, lag=sensor_lag).to(theta.dtype)


def make_pendulum(num_trials: int, num_samples: int) -> Machine:
    """Return the pendulum.

    Args:
        num_trials: To fit.
        num_samples: A trial.
    """
    times = torch.linspace(0, DURATION, num_samples + 1, dtype=torch.float64)[1:]
    dynamics = {
        "coulomb": ("Coulomb", half_normal(0.4), "N m"),
        "quadratic": ("quadratic drag", half_normal(0.06), "N m s^2/rad^2"),
        "cubic": ("cubic spring", half_normal(1.0), "N m/rad^3"),
        "trend": ("trend", normal(0.8), "N m"),
    }
    return Machine(
        name="pendulum",
        fn=partial(swing, times=times),
        prior=box((0.35, 1.0), (0.03, 0.4), (0.4, 1.6), (0.01, 0.15)),
        parameter_names=("length", "damping", "mass", "armature"),
        draw_actions=draw_actions,
        noise_sd=NOISE_SD,
        times=times,
        num_trials=num_trials,
        library=[
            Effect.keyword(
                "sensor lag", prior=half_normal(0.06), units="s", family="observation"
            ),
            *sensor_effects(bias=0.05, gain=0.1, drift=0.01),
            Effect.keyword("motor gain", prior=normal(0.1), family="action"),
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
        wandering=("wander damping", "wander gravity"),
        num_steps=NUM_STEPS,
    )


def draw_actions(num: int) -> Tensor:
    """Return angles, torques and payloads, shape (num, 3)."""
    action = uniform_rows(num, (0.3, 1.7), (-3.0, 3.0), (0.0, 1.0))
    action[:, 0] *= signs(num)
    return action
