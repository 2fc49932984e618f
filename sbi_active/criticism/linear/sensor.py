"""The declared error of the sensor."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.evidence.rival_set import RivalSet
from sbi_active.criticism.rivals.error_models import NoiseCell
from sbi_active.criticism.rivals.noise_grid import measurement_sds

Array = NDArray[Any]


def sensor_error(
    rivals: RivalSet, *, needs_time: bool = True
) -> tuple[Array, list[NoiseCell]] | None:
    """Return the sensor's deviation (N,), and its error with what is unknown of it.

    None if the size of the sensor's error is not declared, x has no time axis, or
    the simulator is random or jumps, unless ``measurement_sd`` says so all the same.

    Args:
        rivals: The models, with the noise as it was declared.
        needs_time: Whether x has to have a time axis.
    """
    noise, m = rivals.model.noise, rivals.measurements
    if noise is None or (needs_time and not m.is_sequence):
        return None
    measured = measurement_sds(noise, m)
    if measured is not None:
        unit = np.broadcast_to(measured, len(m)).astype(float)
        return unit, [NoiseCell.of(m, sd=unit)]
    jumps = not rivals.is_smooth or bool(rivals.roughness.any())
    if jumps or noise.posterior is not None or len(rivals.noise.scales) > 1:
        return None
    unit = rivals.noise.cells[0].sd
    if any(np.isfinite(c.df) or (c.sd != unit).any() for c in rivals.noise.cells):
        return None
    return unit, rivals.noise.cells
