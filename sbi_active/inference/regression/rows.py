"""Rows of a simulator of which faults may hit some."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

from torch import Tensor

from sbi_active.simulation.outcomes import (
    MissingRowsWarning,
    SimulationError,
    Simulations,
)
from sbi_active.simulation.workers.engine import simulate
from sbi_active.simulation.workers.settings import Workers


def rows_of(
    simulator: Callable[..., Any],
    theta: Tensor,
    action: Tensor,
    seed: int,
    workers: Workers,
    *,
    is_first: bool,
) -> Simulations | None:
    """Return simulated rows, those that faults hit among them; None if all are lost.

    Raises:
        SimulationError: If all rows of a first call fail.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MissingRowsWarning)  # they are counted
        try:
            return simulate(simulator, theta, action, seed=seed, workers=workers)
        except SimulationError:  # of a few rows, all may be lost
            if is_first:
                raise
            return None
