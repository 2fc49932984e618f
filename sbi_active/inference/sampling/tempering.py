"""Step lengths from one density towards another."""

from __future__ import annotations

from collections.abc import Callable


def largest_power(
    suffices: Callable[[float], bool],
    *,
    start: float = 0.0,
    end: float = 1.0,
    least: float = 1e-10,
    num_steps: int = 40,
) -> float:
    """Return the largest power that suffices, between a start and an end.

    The search is by bisection; from 0 by powers of ten first, since where a likelihood
    is narrow the first power may be of the order of 1e-8.

    Args:
        suffices: Whether a power of a likelihood, or of a ratio of densities, leaves
            draws enough effective; true up to the answer and false beyond.
        start: Power that is taken to suffice.
        end: Power that is returned where it suffices.
        least: Gone beyond the start even where that does not suffice, so that a
            sequence of steps moves on.
        num_steps: Number of steps of the bisection.
    """
    if suffices(end):
        return end
    low, high = start, end
    for _ in range(num_steps):
        middle = 0.5 * (low + high) if low > 0 else 0.1 * high
        low, high = (middle, high) if suffices(middle) else (low, middle)
    return max(low, start + least)
