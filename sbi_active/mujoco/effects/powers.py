"""Springs and dampers with a power, as forces, where MuJoCo has no field for them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

__all__ = ["PowerForce"]

Array = NDArray[Any]


@dataclass(frozen=True)
class PowerForce:
    r"""A force :math:`-\phi |v|^{p-1} v` or :math:`-\phi (q - q_0)^p` on joints.

    Attributes:
        joints: Place in qpos, place in qvel and rest position of each.
        what: "damping" or "stiffness".
        power: p.
    """

    joints: tuple[tuple[int, int, float], ...]
    what: Literal["damping", "stiffness"]
    power: int

    def __call__(self, q: Array, v: Array, t: float, phi: Array) -> Array:
        """Return the force, shape (n, nv).

        Args:
            q: Positions, shape (n, nq).
            v: Velocities, shape (n, nv).
            t: Time, which is not used.
            phi: Parameters of the effect, shape (n, 1).
        """
        force = np.zeros_like(v)
        for place, dof, rest in self.joints:
            if self.what == "damping":
                speed = v[:, dof]
                force[:, dof] = -phi[:, 0] * np.abs(speed) ** (self.power - 1) * speed
            else:
                force[:, dof] = -phi[:, 0] * (q[:, place] - rest) ** self.power
        return force
