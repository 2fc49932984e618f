r"""A pendulum with a torque motor and a payload that is known.

.. math::
    (m l^2 + J + p l^2)\, \ddot q = u(t) - (m + p)\, g\, l \sin q - b\, \dot q,

released at rest at a known angle. The motor pushes with the torque u from .2 to .5 of
the trial. An action is (angle in rad, torque in N m, payload p in kg), and theta is
(l in m, b in N m s/rad, m in kg, J in kg m^2). The payload makes all four visible.
"""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.misfit.machines.joint import Declared, Joint, row
from benchmarks.misfit.machines.machine import (
    Hidden,
    Machine,
    box,
    signs,
    uniform_rows,
)

GRAVITY = 9.81  # m/s^2
NOISE_SD = 0.01  # rad
JOINT = Joint(3.0, 120, (1.0, 4.0))  # s; undeclared forms in rad and rad/s


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
        if 0.2 <= (k + 0.5) / JOINT.num_steps < 0.5:
            total = total + torque
        return total

    inertia = (mass + payload) * length**2 + armature
    effects = Declared(**declared)
    x = JOINT.trajectory(force, angle, inertia, damping, times, effects, hidden)
    return x.to(theta.dtype)


def make_pendulum(num_trials: int, num_samples: int) -> Machine:
    """Return the pendulum.

    Args:
        num_trials: To fit.
        num_samples: A trial.
    """
    return JOINT.machine(
        swing,
        num_samples,
        name="pendulum",
        prior=box((0.35, 1.0), (0.03, 0.4), (0.4, 1.6), (0.01, 0.15)),
        parameter_names=("length", "damping", "mass", "armature"),
        draw_actions=draw_actions,
        noise_sd=NOISE_SD,
        num_trials=num_trials,
        gain="motor gain",
        lag=0.06,
        strengths=(0.4, 0.06, 1.0, 0.8),
        units=("N m", "N m s^2/rad^2", "N m/rad^3", "N m"),
        loose="gravity",
    )


def draw_actions(num: int) -> Tensor:
    """Return angles, torques and payloads, shape (num, 3)."""
    action = uniform_rows(num, (0.3, 1.7), (-3.0, 3.0), (0.0, 1.0))
    action[:, 0] *= signs(num)
    return action
