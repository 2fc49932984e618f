r"""A pendulum and a driven spring, each with a payload that is known.

The pendulum has a torque motor:

.. math::
    (m l^2 + J + p l^2)\, \ddot q = u(t) - (m + p)\, g\, l \sin q - b\, \dot q,

released at rest at a known angle. The motor pushes with the torque u from .2 to .5 of
the trial. An action is (angle in rad, torque in N m, payload p in kg), and theta is
(l in m, b in N m s/rad, m in kg, J in kg m^2). The payload makes all four visible.

The mass on a spring is driven by a sine:

.. math::
    (m + p)\, \ddot q = a \sin(\omega t) - k (q - r) - c\, \dot q,

released at rest at a known place. An action is (a in N, omega in rad/s, p in kg, place
in m), and theta is (m in kg, k in N/m, c in N s/m, r in m).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from benchmarks.misfit.machines.joint import Declared, Joint, row
from benchmarks.misfit.machines.machine import Hidden, Machine, box, uniform_rows

GRAVITY = 9.81  # m/s^2
NOISE_SD = 0.01  # rad, or m
SWUNG = Joint(3.0, 120, (1.0, 4.0))  # s; undeclared forms in rad and rad/s


def swing(
    theta: Tensor,
    action: Tensor,
    *,
    times: Tensor,
    motor_gain: Tensor | float = 0.0,
    hidden: Hidden | None = None,
    **declared: Tensor | float,
) -> Tensor:
    """Return the angle of the pendulum.

    Every effect is a number, or one a row.

    Args:
        theta: Shape (n, 4).
        action: Shape (n, 3).
        times: s, shape (k,) or (n, k).
        motor_gain: Relative error of the torque.
        hidden: What nobody declared: "force" in N m and "wander damping" and
            "wander gravity", relative, by step, and strengths of forms, N m.
        **declared: Of :class:`Declared`, in s, N m, N m s^2/rad^2, N m/rad^3 and N m.

    Returns:
        Shape (n, k), rad.
    """
    length, damping, mass, armature = theta.double().unbind(1)
    angle, torque, payload = action.double().unbind(1)
    hidden = hidden or {}
    torque = torque * (1 + row(motor_gain, theta))
    weight = (mass + payload) * GRAVITY * length
    loose = hidden.get("wander gravity")

    def force(q: Tensor, v: Tensor, k: int) -> Tensor:
        pull = weight * torch.sin(q)
        total = -pull if loose is None else -pull * (1 + loose[:, k])
        if 0.2 <= (k + 0.5) / SWUNG.num_steps < 0.5:
            total = total + torque
        return total

    inertia = (mass + payload) * length**2 + armature
    effects = Declared(**declared)
    x = SWUNG.trajectory(force, angle, inertia, damping, times, effects, hidden)
    return x.to(theta.dtype)


def make_pendulum(num_trials: int, num_samples: int) -> Machine:
    """Return the pendulum.

    Args:
        num_trials: To fit.
        num_samples: A trial.
    """
    return SWUNG.machine(
        swing,
        num_samples,
        name="pendulum",
        prior=box((0.35, 1.0), (0.03, 0.4), (0.4, 1.6), (0.01, 0.15)),
        parameter_names=("length", "damping", "mass", "armature"),
        draw_actions=lambda num: uniform_rows(
            num, (0.3, 1.7), (-3.0, 3.0), (0.0, 1.0), signed=True
        ),
        noise_sd=NOISE_SD,
        num_trials=num_trials,
        gain="motor gain",
        lag=0.06,
        strengths=(0.4, 0.06, 1.0, 0.8),
        units=("N m", "N m s^2/rad^2", "N m/rad^3", "N m"),
        loose="gravity",
    )


FREQUENCIES = 0.6 * math.pi, 2.2 * math.pi  # rad/s, of the drive
DRIVEN = Joint(4.0, 160, (0.35, 1.5))  # s; undeclared forms in m and m/s


def oscillate(
    theta: Tensor,
    action: Tensor,
    *,
    times: Tensor,
    drive_gain: Tensor | float = 0.0,
    hidden: Hidden | None = None,
    **declared: Tensor | float,
) -> Tensor:
    """Return the place of the mass.

    Every effect is a number, or one a row.

    Args:
        theta: Shape (n, 4).
        action: Shape (n, 4).
        times: s, shape (k,) or (n, k).
        drive_gain: Relative error of the driving force.
        hidden: What nobody declared: "force" in N and "wander damping" and
            "wander stiffness", relative, by step, and strengths of forms, N.
        **declared: Of :class:`Declared`, in s, N, N s^2/m^2, N/m^3 and N.

    Returns:
        Shape (n, k), m.
    """
    mass, stiffness, damping, rest = theta.double().unbind(1)
    amplitude, frequency, payload, start = action.double().unbind(1)
    hidden = hidden or {}
    amplitude = amplitude * (1 + row(drive_gain, theta))
    loose = hidden.get("wander stiffness")
    middles = DRIVEN.step * (torch.arange(DRIVEN.num_steps, dtype=torch.float64) + 0.5)
    drive = amplitude[:, None] * torch.sin(frequency[:, None] * middles)
    drive = drive.T.contiguous()

    def force(q: Tensor, v: Tensor, k: int) -> Tensor:
        pull = stiffness * (q - rest)
        return drive[k] - (pull if loose is None else pull * (1 + loose[:, k]))

    effects = Declared(**declared)
    x = DRIVEN.trajectory(force, start, mass + payload, damping, times, effects, hidden)
    return x.to(theta.dtype)


def make_spring(num_trials: int, num_samples: int) -> Machine:
    """Return the driven mass.

    Args:
        num_trials: To fit.
        num_samples: A trial.
    """
    return DRIVEN.machine(
        oscillate,
        num_samples,
        name="spring",
        prior=box((0.5, 2.0), (8.0, 45.0), (0.15, 1.5), (-0.1, 0.1)),
        parameter_names=("mass", "stiffness", "damping", "rest"),
        draw_actions=lambda num: uniform_rows(
            num, (1.0, 6.0), FREQUENCIES, (0.0, 1.5), (-0.4, 0.4), signed=True
        ),
        noise_sd=NOISE_SD,
        num_trials=num_trials,
        gain="drive gain",
        lag=0.08,
        strengths=(0.6, 0.5, 20.0, 1.0),
        units=("N", "N s^2/m^2", "N/m^3", "N"),
        loose="stiffness",
    )
