"""The prior predictive of the simulator."""

from __future__ import annotations

import numpy as np

from sbi_active.arrays import Array
from sbi_active.criticism.rivals.coordinates import SearchCoordinates
from sbi_active.criticism.rivals.trial_simulator import TrialSimulator

#: A choice: of the prior, which gives deviations to 5 % at a simulation of all trials.
NUM_DRAWS = 200


def predicted_before(
    simulator: TrialSimulator, coordinates: SearchCoordinates, *, seed: int
) -> tuple[Array, Array]:
    """Return mean and deviation of each number over the prior, shapes (N,).

    Args:
        simulator: Simulator of the trials.
        coordinates: Coordinates of the bare model over these trials.
        seed: Seed of the draws.
    """
    u = coordinates.sample(NUM_DRAWS, seed=seed)
    mean, _, _ = simulator.predict(*coordinates.split(u))
    finite = np.isfinite(mean).any(0)
    center, spread = np.zeros((2, mean.shape[1]))
    center[finite] = np.nanmean(mean[:, finite], axis=0)
    spread[finite] = np.nanstd(mean[:, finite], axis=0)
    typical = np.median(spread[spread > 0]) if (spread > 0).any() else 1.0
    if finite.any() and not finite.all():
        # No draw gives a number there: any that the others give is as good.
        center[~finite] = np.mean(center[finite])
        spread[~finite] = np.hypot(typical, np.std(center[finite]))
    return center, np.maximum(spread, 1e-3 * typical)
