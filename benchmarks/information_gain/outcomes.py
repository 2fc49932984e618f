"""Do the errors of estimates that count outcomes without a measurement cover?

For every estimator and world, over seeds: estimates beyond three of their standard
errors of the exact value, and mean and deviation of the error over its standard error.
The nominal number is .0027 of them all. Run from the
root of the repository::

    python -m benchmarks information_gain.outcomes [--seeds 60]
"""

from __future__ import annotations

import torch
from torch import Tensor

from sbi_active.design import (
    EntropyGain,
    InformationGainEstimator,
    NestedGain,
    PosteriorGain,
)
from sbi_active.design.estimators.base import standard_error
from tests.design.fragile import PRIOR, Fragile

__all__ = ["ESTIMATORS", "WORLDS", "errors"]

NUM_SAMPLES = 800
#: Worlds whose validity is a function of the parameters, and ever more luck.
WORLDS = (Fragile(0.0), Fragile(0.4), Fragile(1.5))
ESTIMATORS = (PosteriorGain(), EntropyGain(), NestedGain())


def errors(
    world: Fragile, estimator: InformationGainEstimator, num_seeds: int
) -> tuple[Tensor, Tensor]:
    """Return errors and their standard errors, nats, both (num_seeds, a)."""
    rows = []
    for seed in range(num_seeds):
        gain = estimator(world, world.simulations(NUM_SAMPLES, seed), PRIOR)
        error = gain.nanmean(1) - world.exact()["counted"]
        rows.append(torch.stack([error, torch.stack([*map(standard_error, gain)])]))
    error, reported = torch.stack(rows, 1)
    return error, reported


def main(*, seeds: int = 15) -> None:
    """Print the table.

    Args:
        seeds: Number of seeds.
    """
    torch.set_num_threads(1)
    print(f"{seeds} seeds; errors at the actions .5, 1, 2, 8 in standard errors")
    print(f"{'estimator':14}{'luck':>5}{'> 3':>9}{'mean':>26}{'deviation':>26}")
    for estimator in ESTIMATORS:
        for world in WORLDS:
            error, reported = errors(world, estimator, seeds)
            z = error / reported
            beyond = f"{int((z.abs() > 3).sum())} / {z.numel()}"
            mean, deviation = (
                " ".join(f"{v:5.2f}" for v in part) for part in (z.mean(0), z.std(0))
            )
            name = type(estimator).__name__
            print(f"{name:14}{world.luck:5}{beyond:>9}{mean:>26}{deviation:>26}")
