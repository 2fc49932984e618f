"""Between a trial's own times and the steps of a simulation."""

from __future__ import annotations

import numpy as np

from sbi_active.arrays import Array

#: Share of a step by which a time may be off and count as that of a step.
ON_TIME = 1e-3


def num_steps(times: Array, start: float, step: float) -> int:
    """Return the number of readings, one a step from the start, up to the last time."""
    last = float(np.nanmax(times)) - start
    return max(int(np.ceil(last / step - ON_TIME)), 0) + 1


def held(series: Array, own: Array, num: int, step: float) -> Array:
    """Return a series (n, m), held between the points of its grid, at every step.

    Args:
        series: Series, shape (n, m).
        own: Grid of the series, shape (m,).
        num: Number of steps from the grid's first point.
        step: Time step of the simulation.
    """
    times = own[0] + step * np.arange(num)
    slack = ON_TIME * min(step, own[1] - own[0])
    place = np.searchsorted(own, times + slack, side="right") - 1
    return series[:, np.clip(place, 0, len(own) - 1)]


def sampled(
    readings: Array,
    times: Array,
    start: float,
    step: float,
    late: Array | None = None,
) -> Array:
    """Return readings at times, a line between those of two steps.

    Args:
        readings: Readings, shape (n, steps, c), from the start on.
        times: Times, shape (n, k).
        start: Time of the first reading.
        step: Time between readings.
        late: Delay of each channel, (n, c); None is 0.

    Returns:
        Shape (n, k, c).
    """
    if late is not None:
        each = [
            sampled(readings[..., [c]], times - late[:, [c]], start, step)
            for c in range(readings.shape[2])
        ]
        return np.concatenate(each, 2)
    last = readings.shape[1] - 1
    place = np.clip((times - start) / step, 0, last)
    nearest = np.round(place)
    place = np.where(np.abs(place - nearest) < ON_TIME, nearest, place)
    low = np.floor(place).astype(int)
    weight = (place - low)[..., None]
    high = np.minimum(low + 1, last)
    row = np.arange(len(readings))[:, None]
    found = readings[row, low]
    between = weight[..., 0] > 0
    if between.any():
        line = (1 - weight) * found + weight * readings[row, high]
        found = np.where(between[..., None], line, found)
    return found
