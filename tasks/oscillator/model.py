r"""A driven, damped oscillator read by a sensor of limited range.

The anchor of a mass on a spring is shaken from rest through an actuator of gain
:math:`g` and delay :math:`\tau`,

.. math::
    \ddot y + 2 \zeta \omega_0 \dot y + \omega_0^2 y
    = g\, \omega_0^2\, A \sin(\Omega (t - \tau)), \quad t > \tau, \qquad
    y(\tau) = \dot y(\tau) = 0,

and its displacement is read at six times by a sensor that saturates,

.. math::
    x_k = R \tanh(y(t_k) / R) + \varepsilon_k, \qquad
    \varepsilon_k \sim \mathcal N(0, \sigma^2).

The parameters are :math:`\theta = (\omega_0, \zeta, g, \tau)` and the action is
:math:`\xi = (A, \Omega)`. A drive near the natural frequency tells most, one far above
it hardly moves the mass, and a strong one at resonance only saturates the sensor.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = [
    "ACTIONS",
    "ACTION_HIGH",
    "ACTION_LOW",
    "ACTION_NAMES",
    "ACTION_UNITS",
    "NOISE_SD",
    "PARAMETER_NAMES",
    "PARAMETER_UNITS",
    "PRIOR_HIGH",
    "PRIOR_LOW",
    "SAMPLE_TIMES",
    "SENSOR_RANGE",
    "mean",
]

PARAMETER_NAMES = ("natural_frequency", "damping_ratio", "gain", "delay")
PARAMETER_UNITS = ("rad/s", "", "", "s")
PRIOR_LOW = torch.tensor([2.0, 0.03, 0.5, 0.0])
PRIOR_HIGH = torch.tensor([6.0, 0.5, 2.0, 0.3])

ACTION_NAMES = ("amplitude", "frequency")
ACTION_UNITS = ("cm", "rad/s")
ACTION_LOW = torch.tensor([0.1, 1.0])
ACTION_HIGH = torch.tensor([4.0, 13.0])

#: Candidates, shape (35, 2): five amplitudes by seven frequencies.
ACTIONS = torch.cartesian_prod(
    torch.tensor([0.1, 0.25, 0.6, 1.6, 4.0]),
    torch.tensor([1.0, 3.0, 5.0, 7.0, 9.0, 11.0, 13.0]),
)

SAMPLE_TIMES = torch.tensor([0.5, 1.0, 1.6, 2.3, 3.1, 4.0])  # s
SENSOR_RANGE = 1.0  # R, cm
NOISE_SD = 0.05  # sigma, cm


def mean(theta: Tensor, action: Tensor) -> Tensor:
    r"""Noise-free reading :math:`R \tanh(y(t_k) / R)`, in closed form.

    With :math:`s = \max(t - \tau, 0)`, :math:`\omega_d = \omega_0 \sqrt{1 - \zeta^2}`
    and

    .. math::
        a = \omega_0^2 - \Omega^2, \quad b = 2 \zeta \omega_0 \Omega, \quad
        (p, q) = \frac{g\, \omega_0^2 A}{a^2 + b^2} (a, -b),

    .. math::
        y = p \sin \Omega s + q \cos \Omega s
        - e^{-\zeta \omega_0 s} \left[ q \cos \omega_d s
        + \frac{\zeta \omega_0 q + \Omega p}{\omega_d} \sin \omega_d s \right].

    Evaluated in float64 and differentiable in both arguments.

    Args:
        theta: :math:`(\omega_0, \zeta, g, \tau)`, shape (n, 4); :math:`0 < \zeta < 1`.
        action: :math:`(A, \Omega)`, shape (n, 2). Leading dimensions broadcast:
            (n, 1, 4) with (t, 2) gives (n, t, 6).

    Returns:
        Readings in cm, shape (n, 6), in the dtype of theta.

    Raises:
        ValueError: If the last dimensions are not 4 and 2.

    Example:
        >>> mean(torch.tensor([[4.0, 0.1, 1.0, 0.0]]), torch.tensor([[1.0, 4.0]])).shape
        torch.Size([1, 6])
    """
    rows = theta.ndim >= 2 and action.ndim >= 2
    if not rows or (theta.shape[-1], action.shape[-1]) != (4, 2):
        raise ValueError(
            "expected theta (n, 4) and action (n, 2); got "
            f"{tuple(theta.shape)} and {tuple(action.shape)}; give one row a trial"
        )
    omega_0, zeta, gain, tau = theta.double()[..., None].unbind(-2)
    amplitude, omega = action.double()[..., None].unbind(-2)

    a = omega_0**2 - omega**2
    b = 2 * zeta * omega_0 * omega
    scale = gain * omega_0**2 * amplitude / (a**2 + b**2)
    p, q = scale * a, -scale * b

    s = (SAMPLE_TIMES.to(theta.device, torch.float64) - tau).clamp(min=0)
    omega_d = omega_0 * (1 - zeta**2).sqrt()
    steady = p * torch.sin(omega * s) + q * torch.cos(omega * s)
    transient = q * torch.cos(omega_d * s) + (
        zeta * omega_0 * q + omega * p
    ) / omega_d * torch.sin(omega_d * s)
    y = steady - torch.exp(-zeta * omega_0 * s) * transient
    return (SENSOR_RANGE * torch.tanh(y / SENSOR_RANGE)).to(theta.dtype)
