r"""A position-controlled DC motor that swings a pendulum, without friction.

The firmware turns the error of the position into a duty cycle, which the supply limits,
and the motor turns the voltage into a torque against its own back-EMF:

.. math::
    u &= \mathrm{clip}(g\, k_p\, (r - x), -1, 1), \qquad x = q + q_0, \\
    \tau &= \frac{k_t}{R} (U u - k_t \dot q), \\
    (m l^2 + J)\, \ddot q &= \tau - m g_0 l \sin q - F,

with q = 0 hanging down, x the angle that the encoder reads and r the goal. While torque
is disabled the bridge is open, no current flows and :math:`\tau = 0`: there is no
back-EMF that brakes. The parameters are :math:`\theta = (k_t, R, g, J, q_0)`.

The friction F is zero in the bare model. With effects it is

.. math::
    F = b\, \dot q + \mathrm{sign}(\dot q)
    \left(f_0 + \lambda |m g_0 l \sin q| + \mu |\tau|\right).

With the motor on, :math:`b` adds to :math:`k_t^2 / R` and shows nowhere else, so that
no powered trial tells viscous friction from back-EMF.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

__all__ = [
    "GRAVITY",
    "LENGTH",
    "MASS",
    "PARAMETER_NAMES",
    "PARAMETER_UNITS",
    "PRIOR_HIGH",
    "PRIOR_LOW",
    "STEP",
    "SUPPLY",
    "angles",
]

Array = NDArray[Any]

PARAMETER_NAMES = ("torque_constant", "resistance", "gain", "armature", "zero")
PARAMETER_UNITS = ("V s/rad", "ohm", "1/rad", "kg m^2", "rad")
#: Around the data sheet of such a servo (5 V: no load 10.9 rad/s, stall current 1.5 A;
#: 4096 counts a turn, duty = kp / 128 / 885 a count, that is .0058 a rad and unit of
#: kp), by a factor of two to three either way.
PRIOR_LOW = (0.2, 1.0, 0.002, 0.0, -0.1)
PRIOR_HIGH = (1.2, 10.0, 0.015, 0.03, 0.1)

MASS, LENGTH, GRAVITY = 0.49, 0.1, 9.81  # kg, m, m/s^2
SUPPLY = 7.4  # V
STEP = 0.004  # s
#: Rows that are stepped together, so that they stay in the processor's cache.
BLOCK = 4_096


def angles(
    theta: Array,
    kp: Array,
    goal: Array,
    enabled: Array,
    start: Array,
    trial: NDArray[np.int64],
    *,
    coulomb: Any = 0.0,
    viscous: Any = 0.0,
    load: Any = 0.0,
    torque: Any = 0.0,
    every: int = 1,
) -> Array:
    r"""Return the angles that the encoder reads, by leapfrog steps.

    Forces are those of the half step :math:`q_h = q + \tfrac h2 v`, and all that brakes
    is shared between both ends of a step,

    .. math::
        (I + \tfrac h2 d)\, v' = S_{h f}\bigl((I - \tfrac h2 d)\, v
        + h (\tfrac{k_t}{R} U u - m g_0 l \sin q_h)\bigr), \qquad
        q' = q_h + \tfrac h2 v',

    with I the inertia, d the back-EMF and viscous friction, f the dry friction and
    :math:`S_a(z) = \mathrm{sign}(z) \max(|z| - a, 0)`. Dry friction can stop the
    pendulum and hold it, and never turns it around.

    Args:
        theta: Shape (n, 5).
        kp: Gain of the firmware in each trial, shape (t,).
        goal: r in the middle of each step, rad, shape (t, steps).
        enabled: Share of each step in which torque is enabled, shape (t, steps).
        start: Angle read at the beginning, at rest, rad, shape (t,).
        trial: Row of the trial that each row of theta makes, shape (n,).
        coulomb: f_0, N m; a number or one a row, as all that follows.
        viscous: b, N m s/rad.
        load: lambda.
        torque: mu.
        every: Steps from one angle that is returned to the next.

    Returns:
        Shape (n, steps // every), the first of them after ``every`` steps.
    """
    n = len(theta)
    friction = [
        np.broadcast_to(np.asarray(f, dtype=np.float64).reshape(-1), (n,))
        for f in (coulomb, viscous, load, torque)
    ]
    x = np.empty((n, goal.shape[1] // every))
    # Rows of a trial lie together: the goal is then read once a step.
    order = np.argsort(trial, kind="stable")
    for first in range(0, n, BLOCK):
        rows = order[first : first + BLOCK]
        x[rows] = _steps(
            theta[rows],
            kp,
            goal,
            enabled,
            start,
            trial[rows],
            [f[rows] for f in friction],
            every,
        )
    return x


def _steps(
    theta: Array,
    kp: Array,
    goal: Array,
    enabled: Array,
    start: Array,
    trial: NDArray[np.int64],
    friction: list[Array],
    every: int,
) -> Array:
    kt, resistance, gain, armature, zero = theta.T.copy()
    h, half, weight = STEP, 0.5 * STEP, MASS * GRAVITY * LENGTH
    inertia = MASS * LENGTH**2 + armature
    gain = gain * kp[trial]
    # Torques times the step, in N m s, are what a step adds to the momentum.
    stall, brake = h * SUPPLY * kt / resistance, h * kt**2 / resistance
    coulomb, viscous, load, torque = (h * f for f in friction)
    is_dry = bool(coulomb.any() or load.any() or torque.any())
    by_torque = bool(torque.any())
    goal, enabled = np.ascontiguousarray(goal.T), np.ascontiguousarray(enabled.T)
    always = enabled.min(1) == 1
    damping = 0.5 * (brake + viscous)
    before, after = inertia - damping, 1 / (inertia + damping)
    q, v = start[trial] - zero, np.zeros(len(theta))
    x = np.empty((goal.shape[0] // every, len(theta)))
    for k in range(len(goal)):
        q += half * v
        drive = stall * _clipped(gain * (goal[k][trial] - zero - q))
        back = brake
        if not always[k]:
            on = enabled[k][trial]
            drive, back = on * drive, on * brake
            damping = 0.5 * (back + viscous)
            before, after = inertia - damping, 1 / (inertia + damping)
        # A few times as fast as NumPy's where that has no vector instructions for it.
        sine = torch.sin(torch.from_numpy(q)).numpy()
        momentum = before * v + drive - (h * weight) * sine
        if is_dry:
            dry = coulomb + (weight * load) * np.abs(sine)
            if by_torque:
                dry += (torque / h) * np.abs(drive - back * v)
            momentum -= np.minimum(np.maximum(momentum, -dry), dry)
        v = momentum * after
        q += half * v
        if (k + 1) % every == 0:
            x[(k + 1) // every - 1] = q + zero
    return x.T


def _clipped(duty: Array) -> Array:
    return np.minimum(np.maximum(duty, -1.0), 1.0)
