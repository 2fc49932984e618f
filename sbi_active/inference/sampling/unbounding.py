"""Coordinates without edges, for densities that many edges cut."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

Array = NDArray[Any]


@dataclass(frozen=True)
class Unbounding:
    """Maps axes in [-1, 1] to the real line, where a uniform number is normal.

    Otherwise nearly all draws of a density that is cut at many edges would miss it.

    Attributes:
        axes: Mask of the axes that are mapped, shape (d,); the others stay.
    """

    axes: NDArray[np.bool_]

    def to_line(self, z: Array) -> Array:
        """Return z on the real line, shape (n, d); what is outside goes to the end."""
        y = z.copy()
        share = 0.5 * (1 + z[:, self.axes])
        y[:, self.axes] = ndtri(share.clip(1e-15, 1 - 1e-15))
        return y

    def from_line(self, y: Array) -> Array:
        """Return z, shape (n, d)."""
        z = y.copy()
        z[:, self.axes] = 2 * ndtr(y[:, self.axes]) - 1
        return z

    def log_slope(self, y: Array) -> Array:
        """Return log |dy / dz|, shape (n,)."""
        square = y[:, self.axes] ** 2
        return (0.5 * square + 0.5 * np.log(0.5 * np.pi)).sum(1)
