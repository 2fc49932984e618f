"""The null of an effect among the coordinates of a model."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.rivals.rival import Rival

Array = NDArray[Any]


def at_null(rival: Rival, effect: Effect, tried: float) -> tuple[Array, Array]:
    """Return the null of an effect among the coordinates, and a step from it, (k,).

    Args:
        rival: Rival with this effect.
        effect: The effect.
        tried: Length of the step.
    """
    c, place = rival.coordinates, rival.columns()[effect.name]
    z = c.to_z(np.clip(np.zeros((1, rival.dim)), c.low, c.high))
    # Where no number makes it vanish, the end of the prior that is nearest to it.
    z[:, place] = effect.null_phi(1, finite=True).double().numpy()
    with np.errstate(divide="ignore"):
        u = np.clip(c.from_z(z)[0], c.low, c.high)[place]
    return u, np.where(u + tried > c.high[place], -tried, tried)


def has_null(effect: Effect) -> bool:
    """Return whether some number makes an effect vanish."""
    return bool(effect.null_phi(1).isfinite().all())
