"""World C: the block's whole trajectory, with errors correlated along it.

Fifty camera samples a trial. The errors are first-order autoregressive,

    e_k = rho e_{k-1} + sqrt(1 - rho^2) s n_k,

with a marginal standard deviation s of 5 mm and rho from 0 to .98 by the case. Only the
marginal standard deviation is declared, as a camera's data sheet would.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.criticism.worlds import sliding_block
from benchmarks.criticism.worlds.world import World
from sbi_active import GaussianNoise, SimulatorModel

NUM_SAMPLES = 50
TIMES = tuple(np.round(np.linspace(0.04, 2.0, NUM_SAMPLES), 2).tolist())  # s
CORRELATIONS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98)


def make_world(*, assume_independent: bool = False) -> World:
    """Return world C.

    Args:
        assume_independent: Tell the loop nothing of the time axis, so that it takes
            the declared noise as independent.
    """
    block = sliding_block.make_world()
    model = SimulatorModel(
        sliding_block.bare_model(TIMES),
        noise=GaussianNoise(sliding_block.NOISE_SD),
        parameter_names=block.model.parameter_names,
    )
    return replace(
        block,
        name="C",
        model=model,
        correlations=CORRELATIONS,
        sample_times=() if assume_independent else TIMES,
    )
