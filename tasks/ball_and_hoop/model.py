r"""A DC motor that turns a heavy hoop: voltage over time in, tachometer out.

The bare simulator is linear and of first order,

.. math::
    \dot w = a\, (u + u_0) - b\, w,

with the speed w in V of the tachometer, the command u held between its samples, and
:math:`\theta = (a, b, u_0)`: drive in 1/s, damping in 1/s, offset of the input in V.

With effects it is

.. math::
    \dot w = a\, (g(u) + u_0) - b\, w - c\, w |w| - c_3\, w^3
        - \operatorname{sign}(w)\, (f + s\, e^{-|w| / w_0}).

where g is a dead zone and a gain :math:`1 / (1 + k |u|)`.

By steps of the input's grid: what brakes is shared between both ends of a step, and dry
friction is an impulse that can stop the hoop and hold it, never turn it around.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution, Normal, Uniform

from sbi_active.simulation import AutocorrelatedNoise, SimulatorModel
from sbi_active.tasks.machines import bare_simulator
from sbi_active.tasks.product import Product
from sbi_active.tasks.stepping import between, is_on, lagged, row

__all__ = [
    "PARAMETER_NAMES",
    "PARAMETER_UNITS",
    "SENSOR_SD",
    "STEP",
    "make_noise",
    "make_prior",
    "make_simulator",
    "spin",
]

PARAMETER_NAMES = ("drive", "damping", "offset")
PARAMETER_UNITS = ("1/s", "1/s", "V")
STEP = 0.1  # s, of the input's grid and the integrator
STRIBECK_SPEED = 0.5  # V, where the extra friction at low speed has fallen to 1 / e
WARM = 300.0  # s, in which friction changes by the whole of its effect
FULL = 10.0  # V of the tachometer at a command of 1 V
SENSOR_SD = 0.01  # V: two quanta of the converter
#: Bounds of a factor of five around a time constant of a second or so and a speed of
#: 10 V at 1 V.
DRIVE, DAMPING = (1.0, 30.0), (0.0, 3.0)
OFFSET_SD = 0.01  # V: 1 % of the largest command
#: What a simulator gets wrong: from the sensor's error to a third of the range, V, and
#: from a step to a piece, s.
SD, CORRELATION_TIME = (0.005, 3.0), (0.05, 30.0)

Strength = Tensor | float


def spin(
    theta: Tensor,
    action: Tensor,
    *,
    inputs: Mapping[str, Tensor],
    times: Tensor,
    coulomb: Strength = 0.0,
    stribeck: Strength = 0.0,
    quadratic: Strength = 0.0,
    cubic: Strength = 0.0,
    warm_up: Strength = 0.0,
    dead_zone: Strength = 0.0,
    compression: Strength = 0.0,
    asymmetry: Strength = 0.0,
    delay: Strength = 0.0,
    motor_lag: Strength = 0.0,
    sensor_lag: Strength = 0.0,
    sensor_offset: Strength = 0.0,
    sensor_asymmetry: Strength = 0.0,
    crosstalk: Strength = 0.0,
) -> Tensor:
    r"""Return what the tachometer reads.

    Every effect is a number, or one a row.

    Args:
        theta: Shape (n, 3).
        action: When the record was begun, s, and the first reading, V, shape (n, 2).
        inputs: "voltage", shape (n, m), at the times 0, 0.1, 0.2, ... s.
        times: Of the readings, s, shape (k,) or (n, k), up to the end of the input.
        coulomb: f, V/s.
        stribeck: s, V/s.
        quadratic: c, 1/(V s).
        cubic: :math:`c_3`, 1/(V^2 s).
        warm_up: Relative growth of the damping in 300 s.
        dead_zone: Of the amplifier, V: commands act smaller by it.
        compression: k in a gain of :math:`1 / (1 + k |u|)`, 1/V.
        asymmetry: Relative excess of the gain forward, and loss of it backward.
        delay: Of the command, s.
        motor_lag: Time constant of the torque, s.
        sensor_lag: By which the reading is late, s.
        sensor_offset: V.
        sensor_asymmetry: Relative excess of readings forward, and loss backward.
        crosstalk: Reading lost to the motor's current, V at a current that a command of
            1 V drives at rest.

    Returns:
        Shape (n, k), V.

    Example:
        >>> x = spin(
        ...     torch.tensor([[10.0, 1.0, 0.0]]), torch.zeros(1, 2),
        ...     inputs={"voltage": torch.ones(1, 100)}, times=torch.tensor([10.0]),
        ... )
        >>> round(float(x), 2)
        10.0
    """

    def rows(value: Strength) -> Tensor:
        return row(value, len(theta))

    drive, damping, offset = theta.double().unbind(1)
    begin, w = action.double().unbind(1)
    u = inputs["voltage"].double().nan_to_num()
    u = _late(u, rows(delay))
    u = u.sign() * (u.abs() - rows(dead_zone)[:, None]).clamp(min=0)
    u = u / (1 + rows(compression)[:, None] * u.abs())
    u = u * (1 + rows(asymmetry)[:, None] * u.sign())
    push = (STEP * drive[:, None] * (u + offset[:, None])).T.contiguous()
    dry, creep = STEP * rows(coulomb), STEP * rows(stribeck)
    drag, cube, warm = rows(quadratic), rows(cubic), rows(warm_up)
    lag = rows(motor_lag)
    half = 0.5 * STEP
    is_dry, has_creep = is_on(dry) or is_on(creep), is_on(creep)
    has_drag, has_cube, is_warm = is_on(drag), is_on(cube), is_on(warm)
    if is_on(lag):
        push = lagged(push, lag / STEP)
    brake = half * damping
    path = [w]
    for k in range(len(push)):
        d = brake
        if is_warm:
            d = d * (1 + warm * ((begin + (k + 0.5) * STEP) / WARM))
        speed = w.abs()
        if has_drag:
            d = d + half * drag * speed
        if has_cube:
            d = d + half * cube * speed**2
        momentum = (1 - d) * w + push[k]
        if is_dry:
            most = dry
            if has_creep:
                most = most + creep * torch.exp(-speed / STRIBECK_SPEED)
            momentum = momentum - torch.minimum(torch.maximum(momentum, -most), most)
        w = momentum / (1 + d)
        path.append(w)
    stamps = times.double().expand(len(theta), -1).nan_to_num()
    x = between(torch.stack(path, 1), stamps / STEP - rows(sensor_lag)[:, None] / STEP)
    if is_on(rows(crosstalk)):
        at = (stamps / STEP).round().long().clamp(0, u.shape[1] - 1)
        x = x - rows(crosstalk)[:, None] * (u.gather(1, at) - x / FULL)
    x = x * (1 + rows(sensor_asymmetry)[:, None] * x.sign())
    return (x + rows(sensor_offset)[:, None]).to(theta.dtype)


def _late(u: Tensor, delay: Tensor) -> Tensor:
    """Return the mean of the held command over each step, late by a delay."""
    if not is_on(delay):
        return u
    late = (delay / STEP).clamp(min=0)[:, None]
    whole = late.floor()
    at = torch.arange(u.shape[1]) - whole.long()
    now, before = (u.gather(1, i.clamp(min=0)) for i in (at, at - 1))
    share = late - whole
    return (1 - share) * now + share * before


def make_prior(*, offset_sd: float = OFFSET_SD) -> Distribution:
    """Return the prior of theta; that of the offset is an amplifier's.

    Args:
        offset_sd: Its standard deviation, V.
    """
    drive, damping = (torch.tensor(edges)[:, None] for edges in (DRIVE, DAMPING))
    return Product(
        [
            Uniform(drive[0], drive[1]),
            Uniform(damping[0], damping[1]),
            Normal(torch.zeros(1), torch.tensor([offset_sd])),
        ]
    )


def make_noise() -> AutocorrelatedNoise:
    """Return errors of unknown size and correlation beyond the sensor's."""
    return AutocorrelatedNoise.unknown(
        sd=SD, correlation_time=CORRELATION_TIME, measurement_sd=SENSOR_SD
    )


def make_simulator(**bound: Any) -> SimulatorModel:
    """Return the bare simulator, or with other arguments of :class:`SimulatorModel`."""
    return bare_simulator(spin, PARAMETER_NAMES, make_noise(), bound)
