r"""The fall of a ball that is let go at rest, as a camera sees it.

The bare simulator knows gravity alone,

.. math::
    h(t) = h_0 - \tfrac12 g \, s^2, \qquad s = \max(t - t_0, 0),

and a picture whose scale is off by a factor, and whose heights are bent as those of a
camera that is not level,

.. math::
    x = h + c (h - 47\,\mathrm{m})
    + b \Bigl(\frac{h - 29\,\mathrm{m}}{18\,\mathrm{m}}\Bigr)^2 .

With the keyword argument ``drag`` = :math:`a` the air takes the deceleration
:math:`a ((v + w) / v_0)^p` at the downward speed v where it rises with a ``wind`` of w,
:math:`v_0` = 10 m/s,

.. math::
    \dot v = g - a ((v + w) / v_0)^p, \qquad \dot h = -v,

by the classical Runge-Kutta method on a grid that is dense after the release, where
:math:`v^p` is not smooth, and cubic Hermite interpolation.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, Normal

from sbi_active.simulation import AutocorrelatedNoise, SimulatorModel

__all__ = [
    "GRAVITY",
    "REFERENCE_SPEED",
    "RELEASE_HEIGHT",
    "SAMPLE_TIMES",
    "fall",
    "make_prior",
    "make_simulator",
]

GRAVITY = 9.81  # m/s^2
RELEASE_HEIGHT = 47.0  # m; about where the bridge is
#: Of the camera: the relative error of its scale, and what 2 or 3 degrees of tilt make
#: of the ends of the picture at 60 m, m.
SCALE_SD, BEND_SD = 0.02, 0.3
#: Middle and half width of the heights that it sees, m.
MIDDLE, HALF = 29.0, 18.0
REFERENCE_SPEED = 10.0  # m/s
#: Where nothing says when heights are taken: 15 frames a second.
SAMPLE_TIMES = torch.arange(60, dtype=torch.float64) / 15
NUM_STEPS = 48
#: Errors of digitized video frames in m, and their correlation time in s, from a
#: fraction of a frame to twice the fall.
SD, CORRELATION_TIME = (0.02, 0.2), (0.015, 7.5)


def fall(
    theta: Tensor,
    action: Tensor,
    *,
    times: Tensor | None = None,
    height: Tensor | float = RELEASE_HEIGHT,
    start: Tensor | float = 0.0,
    drag: Tensor | None = None,
    exponent: Tensor | float = 1.0,
    lightness: Tensor | float = 0.0,
    clock: Tensor | float = 0.0,
    wind: Tensor | float = 0.0,
) -> Tensor:
    r"""Return the height of a falling ball.

    Args:
        theta: c, and b in m, shape (n, 2).
        action: The ball's area a mass, m^2/kg, shape (n, 1). Gravity does not ask for
            it.
        times: In s, shape (n, k); None takes ``SAMPLE_TIMES``.
        height: :math:`h_0` in m, a number or shape (n,).
        start: :math:`t_0` in s, alike.
        drag: a in m/s^2, shape (n,); None for none.
        exponent: p, a number or shape (n,).
        lightness: Share of the weight that something carries, alike.
        clock: Relative error of the frame rate: stamps are early by it, alike.
        wind: w in m/s, upward, alike; without drag it does nothing.

    Returns:
        Shape (n, k), m.

    Example:
        >>> h = fall(torch.zeros(1, 2), torch.zeros(1, 1))
        >>> round(float(h[0, 15]), 3)  # after 1 s
        42.095
    """
    stamps = SAMPLE_TIMES.to(theta) if times is None else times
    stamps = stamps.expand(len(theta), -1) * (1 + _column(clock, theta))
    s = (stamps - _column(start, theta)).clamp(min=0)
    g = GRAVITY * (1 - _column(lightness, theta)).expand(len(theta), 1)
    if drag is None:
        way = 0.5 * g * s**2
    else:
        drags = (_column(value, theta) for value in (drag, exponent, wind))
        way = _way(s, g, *drags)
    scale, bend = theta[..., None].unbind(1)
    h = _column(height, theta) - way
    return h + scale * (h - RELEASE_HEIGHT) + bend * ((h - MIDDLE) / HALF) ** 2


def _column(value: Tensor | float, like: Tensor) -> Tensor:
    return torch.as_tensor(value).to(like).reshape(-1, 1)


def _way(s: Tensor, g: Tensor, drag: Tensor, exponent: Tensor, wind: Tensor) -> Tensor:
    """Return the way fallen at times s (n, k) after the release, shape (n, k)."""
    last = s.amax(1, keepdim=True).clamp(min=1e-6)

    def acceleration(v: Tensor) -> Tensor:
        through = (v + wind).clamp(min=0)
        return g - drag * (through / REFERENCE_SPEED) ** exponent

    v, y = torch.zeros_like(last), torch.zeros_like(last)
    knots = [(y, v, acceleration(v))]
    for k in range(NUM_STEPS):
        dt = last * ((k + 1) ** 2 - k**2) / NUM_STEPS**2
        a1 = knots[-1][2]
        a2 = acceleration(v + 0.5 * dt * a1)
        a3 = acceleration(v + 0.5 * dt * a2)
        a4 = acceleration(v + dt * a3)
        y = y + dt * v + dt**2 / 6 * (a1 + a2 + a3)
        v = v + dt / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        knots.append((y, v, acceleration(v)))
    grid_y, grid_v, _ = (torch.cat(part, 1) for part in zip(*knots, strict=True))
    # The grid is s = last (k / K)^2.
    at = (NUM_STEPS * (s / last).sqrt()).floor().long().clamp(0, NUM_STEPS - 1)
    low, high = (last * (i / NUM_STEPS) ** 2 for i in (at, at + 1))
    dt = high - low
    w = (s - low) / dt
    y0, y1 = grid_y.gather(1, at), grid_y.gather(1, at + 1)
    v0, v1 = dt * grid_v.gather(1, at), dt * grid_v.gather(1, at + 1)
    rise = y1 - y0
    return y0 + w * (v0 + w * (3 * rise - 2 * v0 - v1 + w * (v0 + v1 - 2 * rise)))


def make_prior() -> Distribution:
    """Return the prior of the camera; gravity is known."""
    sd = torch.tensor([SCALE_SD, BEND_SD])
    return Independent(Normal(torch.zeros(2), sd), 1)


def make_simulator(**bound: Any) -> SimulatorModel:
    """Return the simulator with gravity alone.

    The heights come without error bars: their standard deviation is log-uniform from 2
    to 20 cm, some pixels, and their correlation along a fall is unknown too.

    Args:
        bound: Keyword arguments of :class:`SimulatorModel` in place of these.
    """
    options: dict[str, Any] = {
        "noise": AutocorrelatedNoise.unknown(
            sd=SD, correlation_time=CORRELATION_TIME, num_sds=16, num_times=10
        ),
        "parameter_names": ["picture scale", "picture bend"],
        "sample_times": SAMPLE_TIMES,
    }
    return SimulatorModel(fall, **{**options, **bound})
