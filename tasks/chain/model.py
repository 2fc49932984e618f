r"""Masses in a row, coupled by springs, shaken at one end and clamped at a place.

Mass i hangs between springs i and i + 1, spring 1 on a wall and the last mass free.
An action :math:`\xi = (\Omega, c)` clamps all masses beyond the first c and pushes the
first one from rest,

.. math::
    M \ddot y + C \dot y + K y = F \sin(\Omega t)\, e_1, \qquad
    y(0) = \dot y(0) = 0,

for the c masses that move, of which each mode has the damping ratio
:math:`\zeta = .03`. The displacement of every mass, clamped ones too, is read at ten
times with Gaussian noise. Springs beyond the clamp and clamped masses change nothing:
trials that all clamp early leave them as the prior has them.

The parameters are the stiffnesses of the n springs and the first masses,
:math:`\theta = (k_1, \dots, k_n, m_1, \dots)`; of an odd number of parameters the last
mass is missing and known. In modes :math:`M^{-1/2} K M^{-1/2} = V \omega^2 V^\top` the
motion has a closed form.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = [
    "DAMPING",
    "FORCE",
    "MASS",
    "NOISE_SD",
    "NUM_TIMES",
    "SAMPLE_TIMES",
    "SPREAD",
    "STIFFNESS",
    "mean",
    "num_masses",
]

STIFFNESS = 400.0  # N/m, median of the prior
MASS = 1.0  # kg
SPREAD = 0.3  # of the logarithms under the prior
DAMPING = 0.03
FORCE = 10.0  # N
SAMPLE_TIMES = torch.linspace(0.2, 2.0, 10, dtype=torch.float64)  # s
NUM_TIMES = len(SAMPLE_TIMES)
NOISE_SD = 2e-3  # m


def num_masses(parameters: int) -> int:
    """Return the masses of a chain with so many parameters."""
    return (parameters + 1) // 2


def mean(theta: Tensor, action: Tensor) -> Tensor:
    r"""Noise-free displacements in closed form, in metres.

    Args:
        theta: Stiffnesses in N/m and masses in kg, all positive, shape (n, p).
        action: :math:`(\Omega, c)` in rad/s and masses, shape (n, 2); c is rounded, and
            at least 1.

    Returns:
        Shape (n, masses, 10), in the dtype of theta; differentiable in theta.

    Raises:
        ValueError: If the shapes do not fit.

    Example:
        >>> theta = torch.tensor([[400.0, 400.0, 1.0, 1.0]])
        >>> mean(theta, torch.tensor([[10.0, 1.0]]))[0, 1].abs().max().item()
        0.0
    """
    if theta.ndim != 2 or action.ndim != 2 or action.shape[1] != 2:
        raise ValueError(
            "expected theta (n, parameters) and action (n, 2); got "
            f"{tuple(theta.shape)} and {tuple(action.shape)}; give one row a trial"
        )
    count = num_masses(theta.shape[1])
    stiffness = theta[:, :count].double()
    mass = theta[:, count:].double()
    known = torch.full((len(theta), count - mass.shape[1]), MASS, dtype=mass.dtype)
    mass = torch.cat([mass, known.to(mass.device)], 1)
    moving = action[:, 1].round().long().clamp(1, count)
    y = theta.new_zeros((len(theta), count, NUM_TIMES), dtype=torch.float64)
    for c in moving.unique().tolist():
        rows = (moving == c).nonzero()[:, 0]
        # The spring beyond the last moving mass holds it to the clamp.
        springs = stiffness[rows, : c + 1]
        part = _motion(springs, mass[rows, :c], action[rows, 0].double())
        filled = torch.nn.functional.pad(part, (0, 0, 0, count - c))
        y = y.index_copy(0, rows, filled)
    return y.to(theta.dtype)


def _motion(stiffness: Tensor, mass: Tensor, drive: Tensor) -> Tensor:
    """Return displacements (n, c, times) of c moving masses.

    Args:
        stiffness: Shape (n, c + 1), or (n, c) where the last mass is free.
        mass: Shape (n, c).
        drive: Angular frequency, shape (n,).
    """
    c = mass.shape[1]
    right = torch.nn.functional.pad(stiffness[:, 1:], (0, c + 1 - stiffness.shape[1]))
    root = mass.rsqrt()
    diagonal = (stiffness[:, :c] + right[:, :c]) * root**2
    off = -stiffness[:, 1:c] * root[:, 1:] * root[:, :-1]
    matrix = torch.diag_embed(diagonal)
    matrix = matrix + torch.diag_embed(off, 1) + torch.diag_embed(off, -1)
    square, mode = torch.linalg.eigh(matrix)
    force = FORCE * root[:, :1] * mode[:, 0]  # of each mode, (n, c)
    q = _driven(square, force, drive[:, None])
    return torch.einsum("nij,njt->nit", root[:, :, None] * mode, q)


def _driven(square: Tensor, force: Tensor, drive: Tensor) -> Tensor:
    r"""Return modes (n, c, times) of squared frequencies (n, c), driven from rest.

    With :math:`a = \omega^2 - \Omega^2`, :math:`b = 2 \zeta \omega \Omega` and
    :math:`(p, r) = f (a, -b) / (a^2 + b^2)`,

    .. math::
        q = p \sin \Omega t + r \cos \Omega t - e^{-\zeta \omega t} \Bigl[
        r \cos \omega_d t + \frac{\zeta \omega r + \Omega p}{\omega_d}
        \sin \omega_d t \Bigr].
    """
    times = SAMPLE_TIMES.to(square.device)
    omega = square.clamp_min(1e-12).sqrt()
    a, b = square - drive**2, 2 * DAMPING * omega * drive
    scale = force / (a**2 + b**2)
    p, r = (scale * a)[..., None], (-scale * b)[..., None]
    natural, omega = omega[..., None], drive[..., None]
    damped = natural * (1 - DAMPING**2) ** 0.5
    steady = p * torch.sin(omega * times) + r * torch.cos(omega * times)
    rate = (DAMPING * natural * r + omega * p) / damped
    free = r * torch.cos(damped * times) + rate * torch.sin(damped * times)
    return steady - torch.exp(-DAMPING * natural * times) * free
