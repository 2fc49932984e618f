r"""Two tanks in series: pump voltage over time in, level of the lower tank out.

The bare simulator has Torricelli's law in both tanks, whose levels have no limit,

.. math::
    \dot h_1 = k_4\, u - k_1 \sqrt{h_1}, \qquad
    \dot h_2 = k_2 \sqrt{h_1} - k_3 \sqrt{h_2},

in V of the sensor, which reads :math:`h_2` and whose rim is at 10 V;
:math:`\theta = (k_1, k_2, k_3, k_4)`. The upper level is in units of a tenth of its own
rim and never read, so that without overflow its scale shows nowhere.

Start levels are unknown. The lower one is about the first reading y, and the upper one
about what lets the reading begin with the slope that it has,

.. math::
    h_1(0) = \Bigl(\frac{\dot y + k_3 \sqrt{y}}{k_2}\Bigr)^2 + \delta_1, \qquad
    h_2(0) = y + \delta_2,

with whatever else flows, where there are such effects.

By midpoint steps of the input's grid. What stands above a rim runs over at the rate

.. math::
    s = \frac{\omega}{(1 - \omega)\, 100\,\mathrm{s}},

from the upper tank into the lower one, and from the lower one into the sink. Tanks that
settle within some 100 s then stand above their rims by :math:`1 - \omega` of what they
would without, so that x is nearly linear in :math:`\omega` from no rim at 0 to a sharp
one at 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from sbi.utils import BoxUniform
from torch import Tensor

from sbi_active.simulation import AutocorrelatedNoise, SimulatorModel
from sbi_active.tasks.machines import bare_simulator
from sbi_active.tasks.stepping import between, is_on, lagged, row

__all__ = [
    "PARAMETER_NAMES",
    "PARAMETER_UNITS",
    "PRIOR_HIGH",
    "PRIOR_LOW",
    "RIM",
    "SENSOR_SD",
    "STEP",
    "levels",
    "make_noise",
    "make_prior",
    "make_simulator",
]

PARAMETER_NAMES = ("upper_outlet", "inlet", "lower_outlet", "pump")
PARAMETER_UNITS = ("V^.5/s", "V^.5/s", "V^.5/s", "1/s")
#: By a factor of ten around tanks that settle within some minutes.
PRIOR_LOW = (0.01, 0.01, 0.02, 0.01)
PRIOR_HIGH = (0.12, 0.15, 0.2, 0.12)
STEP = 4.0  # s, of the input's grid and the integrator
RIM = 10.0  # V
HIGHEST = 100.0  # V; what runs away stays there
MIDDLE = 5.0  # V, about which curves bend
PUMP_MIDDLE = 2.8  # V
SETTLING = 100.0  # s, time constant of a tank
NEWTON = 4  # steps to the upper level
FADE = 4096.0  # s, of a whole record
SENSOR_SD = 0.02  # V
#: What a simulator gets wrong: from the sensor's error to a fifth of the range, V, and
#: from a sample to a piece, s.
SD, CORRELATION_TIME = (0.01, 2.0), (4.0, 500.0)

Strength = Tensor | float


def levels(
    theta: Tensor,
    action: Tensor,
    *,
    inputs: Mapping[str, Tensor],
    times: Tensor,
    upper_start: Strength = 0.0,
    lower_start: Strength = 0.0,
    overflow: Strength = 0.0,
    upper_linear: Strength = 0.0,
    lower_linear: Strength = 0.0,
    exponent: Strength = 0.0,
    leak: Strength = 0.0,
    loss: Strength = 0.0,
    pump_curve: Strength = 0.0,
    pump_lag: Strength = 0.0,
    pump_dead_zone: Strength = 0.0,
    pump_fade: Strength = 0.0,
    sensor_lag: Strength = 0.0,
    sensor_offset: Strength = 0.0,
    sensor_curve: Strength = 0.0,
    sensor_saturation: Strength = 0.0,
) -> Tensor:
    r"""Return what the level sensor of the lower tank reads.

    Every effect is a number, or one a row.

    Args:
        theta: Shape (n, 4).
        action: When the record was begun, s, the first reading, V, and its slope, V/s,
            shape (n, 3).
        inputs: "voltage", shape (n, m), at the times 0, 4, 8, ... s.
        times: Of the readings, s, shape (k,) or (n, k), up to the end of the input.
        upper_start: delta_1, V.
        lower_start: delta_2, V.
        overflow: :math:`\omega`, from 0 to 1; more is a sharp rim as well.
        upper_linear: m, by which the upper tank's outflow is in proportion to its level
            and not to the root of it: :math:`k_1 \sqrt{5}\, ((1 - m) \sqrt{h / 5} +
            m\, h / 5)`, so that at 5 V it is what it was.
        lower_linear: The same of the lower tank.
        exponent: By which both outflows' exponent exceeds 1/2, about 5 V.
        leak: Outflow of the upper tank into the sink in proportion to its level, 1/s.
        loss: Constant outflow of the lower tank, V/s.
        pump_curve: Relative change of the flow a volt above 2.8 V.
        pump_lag: Time constant of the pump, s.
        pump_dead_zone: V.
        pump_fade: Relative loss of the pump in 4,096 s.
        sensor_lag: By which the reading is late, s.
        sensor_offset: V.
        sensor_curve: Reading beyond the level at 0 and 10 V, as a parabola, V.
        sensor_saturation: Share of a level above 10 V that the sensor does not show.

    Returns:
        Shape (n, k), V.

    Example:
        >>> theta = torch.tensor([[0.05, 0.05, 0.05, 0.04]])
        >>> voltage = torch.full((1, 1_000), 2.5)  # settles at (.04 * 2.5 / .05)^2
        >>> x = levels(
        ...     theta, torch.tensor([[0.0, 1.0, 0.0]]), inputs={"voltage": voltage},
        ...     times=torch.tensor([4_000.0]),
        ... )
        >>> round(float(x), 2)
        4.0
    """

    def rows(value: Strength) -> Tensor:
        return row(value, len(theta))

    k1, k2, k3, k4 = theta.double().unbind(1)
    begin, first, slope = action.double().unbind(1)
    u = inputs["voltage"].double().nan_to_num()
    u = (u - rows(pump_dead_zone)[:, None]).clamp(min=0)
    u = u * (1 + rows(pump_curve)[:, None] * (u - PUMP_MIDDLE))
    middles = STEP * (torch.arange(u.shape[1], dtype=torch.float64) + 0.5)
    u = u * (1 - rows(pump_fade)[:, None] * (begin[:, None] + middles) / FADE)
    flow = (k4[:, None] * u).T.contiguous()
    if is_on(rows(pump_lag)):
        flow = lagged(flow, rows(pump_lag) / STEP)
    up, down = rows(upper_linear), rows(lower_linear)
    seep, lost, bend = rows(leak), rows(loss), rows(exponent)
    omega = rows(overflow).clamp(0, 1)
    rate = omega / ((1 - omega).clamp(min=1e-9) * SETTLING)
    spilled = -torch.expm1(-STEP * rate)
    ratio = k2 / k1
    is_bent, has_linear = is_on(bend), is_on(up) or is_on(down)
    has_loss, spills = is_on(seep) or is_on(lost), is_on(spilled)

    def outflow(h: Tensor) -> Tensor:
        h = h.clamp(min=0)
        flow = torch.sqrt(h)
        return flow * ((h + 1e-9) / MIDDLE) ** bend if is_bent else flow

    def change(h1: Tensor, h2: Tensor, pumped: Tensor) -> tuple[Tensor, Tensor]:
        out, below = k1 * outflow(h1), k3 * outflow(h2)
        if has_linear:
            out = (1 - up) * out + up * k1 * h1 / MIDDLE**0.5
            below = (1 - down) * below + down * k3 * h2 / MIDDLE**0.5
        d1, d2 = pumped - out, ratio * out - below
        if has_loss:
            d1, d2 = d1 - seep * h1, d2 - lost * (h2 > 0)
        return d1, d2

    below = k3 * ((1 - down) * outflow(first) + down * first / MIDDLE**0.5)
    wanted = (slope + below + lost).clamp(min=0) / ratio
    h1 = _level(wanted, (1 - up) * k1, up * k1 / MIDDLE**0.5) + rows(upper_start)
    h1 = h1.clamp(min=0)
    h2 = first + rows(lower_start)
    path = [h2]
    for pumped in flow:
        d1, d2 = change(h1, h2, pumped)
        d1, d2 = change(h1 + 0.5 * STEP * d1, h2 + 0.5 * STEP * d2, pumped)
        h1 = (h1 + STEP * d1).clamp(0, HIGHEST)
        h2 = (h2 + STEP * d2).clamp(0, HIGHEST)
        if spills:
            over = spilled * (h1 - RIM).clamp(min=0)
            h1, h2 = h1 - over, h2 + ratio * over
            h2 = h2 - spilled * (h2 - RIM).clamp(min=0)
        path.append(h2)
    stamps = times.double().expand(len(theta), -1).nan_to_num()
    x = between(torch.stack(path, 1), (stamps - rows(sensor_lag)[:, None]) / STEP)
    x = x - rows(sensor_saturation)[:, None].clamp(max=1) * (x - RIM).clamp(min=0)
    x = x + rows(sensor_curve)[:, None] * (x / MIDDLE - 1) ** 2
    return (x + rows(sensor_offset)[:, None]).to(theta.dtype)


def _level(flow: Tensor, outlet: Tensor, linear: Tensor) -> Tensor:
    """Return the level at which a tank lets out a flow, by Newton's method."""
    whole = outlet + linear * MIDDLE**0.5
    root = flow / whole  # exact where all is turbulent, or the level 5 V
    for _ in range(NEWTON if is_on(linear) else 0):
        excess = (outlet + linear * root) * root - flow
        slope = torch.maximum(outlet + 2 * linear * root, 0.2 * whole)
        root = (root - excess / slope).clamp(min=0)
    return root**2


def make_prior() -> BoxUniform:
    """Return the prior of theta."""
    return BoxUniform(torch.tensor(PRIOR_LOW), torch.tensor(PRIOR_HIGH))


def make_noise() -> AutocorrelatedNoise:
    """Return errors of unknown size and correlation beyond the sensor's."""
    return AutocorrelatedNoise.unknown(
        sd=SD, correlation_time=CORRELATION_TIME, measurement_sd=SENSOR_SD
    )


def make_simulator(**bound: Any) -> SimulatorModel:
    """Return the bare simulator, or with other arguments of :class:`SimulatorModel`."""
    return bare_simulator(levels, PARAMETER_NAMES, make_noise(), bound)
