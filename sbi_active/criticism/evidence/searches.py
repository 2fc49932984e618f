"""Searches for the modes of rivals by least squares, before anything is sampled."""

from __future__ import annotations

from collections.abc import Mapping

from sbi_active.criticism.evidence.fit import Fit
from sbi_active.criticism.evidence.least_squares import (
    NESTED,
    ROUGH,
    THOROUGH,
    Modes,
    find_modes,
)
from sbi_active.criticism.evidence.starts import starts_near_parents
from sbi_active.criticism.results import ModelKey
from sbi_active.criticism.rivals.rival import Rival

__all__ = ["search"]


def search(
    rival: Rival,
    fits: Mapping[ModelKey, Fit],
    step: float,
    is_smooth: bool,
    *,
    seed: int,
) -> Modes:
    """Return the modes of a rival, from where smaller ones ended.

    Args:
        rival: Whose modes are looked for.
        fits: Rivals whose posterior is known.
        step: Of finite differences.
        is_smooth: Whether derivatives mean anything.
        seed: Of the starts.
    """
    near = starts_near_parents(fits, rival, seed)
    how = ROUGH
    if is_smooth:
        how = THOROUGH if near is None else NESTED
    return find_modes(rival, step=step, seed=seed, near=near, search=how)
