"""Generalized forces, keys of a simulator's argument ``force``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from sbi_active.arrays import Array


class Force(Protocol):
    r"""A generalized force :math:`\tau = \tau(q, v, t; \phi)`, added at every step.

    It is hashable and can be pickled; rows are independent.
    """

    def __call__(self, q: Array, v: Array, t: float, phi: Array, /) -> Array:
        """Return the force on each degree of freedom, shape (n, nv), N or N m.

        Args:
            q: Positions, shape (n, nq).
            v: Velocities, shape (n, nv).
            t: Time since the start of the trial, s.
            phi: Parameters of the effect, shape (n, k).
        """
        ...


def total_force(
    force: Mapping[Force, Tensor] | None, q: Tensor, v: Tensor, t: float
) -> Tensor:
    r"""Return the sum of forces on a simulator's joints, at one time.

    A simulator ``fn(theta, action, *, force=None)`` adds it to what its joints feel:
    :math:`M(q) \dot v = \ldots + \tau`. The effects of :func:`.force_effects` then act
    on it.

    Args:
        force: Force as the simulator was given it; None is no force.
        q: Positions, shape (n, nq).
        v: Velocities, shape (n, nv).
        t: Time since the start of the trial, s.

    Returns:
        Shape (n, nv), of v's dtype.

    Example:
        >>> q, v = torch.zeros(2, 1), torch.ones(2, 1)
        >>> total_force(None, q, v, 0.0).shape
        torch.Size([2, 1])
    """
    total = np.zeros(tuple(v.shape))
    if force:
        positions, speeds = q.double().numpy(), v.double().numpy()
        with np.errstate(invalid="ignore"):  # of rows that diverge
            for one, phi in force.items():
                total += one(positions, speeds, t, phi.double().numpy())
    return torch.from_numpy(total).to(v.dtype)
