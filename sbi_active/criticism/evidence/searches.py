"""Searches for the modes of rivals by least squares, before anything is sampled."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

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
from sbi_active.seeding import derive_seed

if TYPE_CHECKING:
    from sbi_active.criticism.evidence.rival_set import RivalSet

#: Nats by which another search may end higher and count as having found the same.
NO_MORE = 1.0


def search(rivals: RivalSet, rival: Rival, seed: int) -> Modes:
    """Return the modes of a rival.

    Args:
        rivals: All models.
        rival: Whose modes are looked for.
        seed: Of the starts.
    """
    near = starts_near_parents(rivals.fits, rival, seed)
    how = ROUGH
    if rivals.is_smooth:
        how = THOROUGH if near is None else NESTED
    return find_modes(rival, step=rivals.step, seed=seed, near=near, search=how)


def promise(rivals: RivalSet, key: ModelKey) -> float:
    """Return the largest log posterior density that a search finds of a model.

    It costs a part of a fit, which then goes on from there.

    Args:
        rivals: All models.
        key: Which of them.
    """
    if key in rivals.fits:
        return np.inf
    rival = rivals.rival(key)
    modes = search(rivals, rival, derive_seed(rivals.seed, "evidence", str(key)))
    rivals.modes[key] = modes
    return float((rival.log_prior(modes.u) + rival.log_likelihood(modes.u)).max())


def is_found_again(rivals: RivalSet) -> bool:
    """Return whether another search ends where the bare model was sampled.

    It starts where other models have its parameters: what an effect that is there had
    drawn the first search away from, the model that has it shows.

    Args:
        rivals: All models, of which some are fitted.
    """
    fit, seed = rivals.fit(), derive_seed(rivals.seed, "again")
    rival = fit.rival
    others = [other for key, other in rivals.fits.items() if key != ModelKey()]
    others.sort(key=lambda other: -other.evidence.log_evidence)
    near = None
    if others:
        z = [
            other.rival.coordinates.to_z(other.likeliest)[:, : rival.dim]
            for other in others[: NESTED.num_near]
        ]
        near = rival.coordinates.from_z(np.concatenate(z))
    modes = find_modes(rival, step=rivals.step, seed=seed, near=near, search=NESTED)
    own, again = (
        float((rival.log_prior(u) + rival.log_likelihood(u)).max())
        for u in (fit.sample.u, modes.u)
    )
    return again < own + NO_MORE
