"""Where an effect vanishes, among the coordinates of a model."""

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
        rival: With this effect alone.
        effect: The effect.
        tried: Length of the step.
    """
    c, place = rival.coordinates, rival.columns()[effect.name]
    null = effect.null_phi(1).double().numpy()
    z = c.to_z(np.clip(np.zeros((1, rival.dim)), c.low, c.high))
    low, high = c.low[place], c.high[place]
    if has_null(effect):
        z[:, place] = null
        u = c.from_z(z)[0, place]
    else:  # the end of the prior that is nearest to it
        u = np.where(null[0] > 0, high, low)
    return np.clip(u, low, high), np.where(u + tried > high, -tried, tried)


def has_null(effect: Effect) -> bool:
    """Return whether some number makes an effect vanish."""
    return bool(effect.null_phi(1).isfinite().all())
