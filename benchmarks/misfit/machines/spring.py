r"""A mass on a spring, driven by a sine, with a payload that is known.

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
from benchmarks.misfit.machines.machine import (
    Hidden,
    Machine,
    box,
    signs,
    uniform_rows,
)

NOISE_SD = 0.01  # m
JOINT = Joint(4.0, 160, (0.35, 1.5))  # s; undeclared forms in m and m/s


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
    middles = JOINT.step * (torch.arange(JOINT.num_steps, dtype=torch.float64) + 0.5)
    drive = amplitude[:, None] * torch.sin(frequency[:, None] * middles)
    drive = drive.T.contiguous()

    def force(q: Tensor, v: Tensor, k: int) -> Tensor:
        pull = stiffness * (q - rest)
        return drive[k] - (pull if loose is None else pull * (1 + loose[:, k]))

    effects = Declared(**declared)
    x = JOINT.trajectory(force, start, mass + payload, damping, times, effects, hidden)
    return x.to(theta.dtype)


def make_spring(num_trials: int, num_samples: int) -> Machine:
    """Return the driven mass.

    Args:
        num_trials: To fit.
        num_samples: A trial.
    """
    return JOINT.machine(
        oscillate,
        num_samples,
        name="spring",
        prior=box((0.5, 2.0), (8.0, 45.0), (0.15, 1.5), (-0.1, 0.1)),
        parameter_names=("mass", "stiffness", "damping", "rest"),
        draw_actions=draw_actions,
        noise_sd=NOISE_SD,
        num_trials=num_trials,
        gain="drive gain",
        lag=0.08,
        strengths=(0.6, 0.5, 20.0, 1.0),
        units=("N", "N s^2/m^2", "N/m^3", "N"),
        loose="stiffness",
    )


def draw_actions(num: int) -> Tensor:
    """Return forces, frequencies, payloads and places, shape (num, 4)."""
    action = uniform_rows(
        num, (1.0, 6.0), (0.6 * math.pi, 2.2 * math.pi), (0.0, 1.5), (-0.4, 0.4)
    )
    action[:, 0] *= signs(num)
    return action
