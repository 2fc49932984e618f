"""The error of the sensor, as linear models take it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sbi_active.arrays import Array
from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.rivals.error_models import NoiseCell, NoiseGrid
from sbi_active.criticism.rivals.noise_grid import measurement_sds


@dataclass(frozen=True)
class Sensor:
    """The error of the sensor alone.

    Attributes:
        unit: Its standard deviation, shape (N,); a typical one where it is unknown.
        noise: Distribution of the error.
        is_known: Whether its size is declared.
        df: Degrees of freedom of t errors; inf for Gaussian ones.
    """

    unit: Array
    noise: NoiseGrid
    is_known: bool
    df: float = np.inf


def sensor_of(rivals: RivalSet) -> Sensor:
    """Return the sensor's error.

    What a simulator that jumps strays from any smooth function is part of it, unless
    ``measurement_sd`` says what it is. A random simulator has a deviation of its own,
    which is the unit.

    Args:
        rivals: The models, with the noise as it was declared.
    """
    noise, m, grid = rivals.model.noise, rivals.measurements, rivals.noise
    measured = measurement_sds(noise, m)
    if measured is not None:
        unit = np.broadcast_to(measured, len(m)).astype(float)
        return Sensor(unit, NoiseGrid([NoiseCell.of(m, sd=unit)]), is_known=True)
    df = float(np.median([cell.df for cell in grid.cells]))
    if np.isfinite(df):
        cells = [replace(cell, df=np.inf) for cell in grid.cells]
        grid = replace(grid, cells=cells)
    if noise is None:
        unit = rivals.typical_deviation()
        cells = [replace(cell, sd=unit) for cell in grid.cells]
        return Sensor(unit, replace(grid, cells=cells), is_known=True)
    unit, is_declared = grid.cells[0].sd, noise.posterior is None
    one_size = all((cell.sd == unit).all() for cell in grid.cells)
    if is_declared and one_size and len(grid.scales) == 1:
        return Sensor(unit, grid, is_known=True, df=df)
    return Sensor(grid.typical_sd, grid, is_known=False, df=df)
