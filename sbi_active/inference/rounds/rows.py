"""Contents of a round with actions: checked rows, simulated ones, and real trials."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from sbi.utils import RestrictedPrior
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.expected import require
from sbi_active.messages import Explained, warn
from sbi_active.simulation.outcomes import (
    MissingRowsWarning,
    SimulationError,
    Simulations,
)
from sbi_active.simulation.workers.engine import simulate
from sbi_active.simulation.workers.settings import Workers


class UnexplainedOutcomeError(Explained, ValueError):
    """A trial gave a measurement where simulations give none."""

    code = "SA119"


NOTHING_EXPLAINS = (
    "expected outcomes that some parameters may explain; got none with a likelihood; "
    "correct the outcome, or leave the trial out"
)


@dataclass(frozen=True)
class Observation:
    """A real trial: the executed action, shape (action_dim,), and x, shape x_shape."""

    action: Tensor
    x: Tensor


def require_whole(x: Tensor) -> None:
    """Raise if numbers of an outcome (n, *x_shape) are missing and others not."""
    present = torch.as_tensor(x).reshape(len(x), -1).isfinite()
    partly = present.any(1) & ~present.all(1)
    if bool(partly.any()):
        row = int(partly.nonzero()[0])
        raise ValueError(
            "expected outcomes that are measured or NaN throughout, since a likelihood "
            f"of some of the numbers is not learned; got {int(partly.sum())} of "
            f"{len(x)} measured in part, the first in row {row}; leave out the "
            "numbers that go missing, or use ASBI"
        )


def check_proposal(proposal: Any, belief: Distribution | None) -> None:
    """Raise unless theta is drawn from the belief or a truncation of it."""
    truncated = isinstance(proposal, RestrictedPrior) and proposal._prior is belief
    require(
        proposal is None or proposal is belief or truncated,
        "proposal to be the belief or sbi's RestrictedPrior of it, since a round with "
        "actions is trained by plain maximum likelihood and any other proposal would "
        "take the belief's place",
        type(proposal).__name__,
        "pass belief= the distribution theta was drawn from",
    )


def warn_missing(num_missing: int, num_simulations: int, left_out: str) -> None:
    """Warn that faults of a simulator took some of a refinement's simulations.

    Args:
        num_missing: Number of those.
        num_simulations: Number of all.
        left_out: What was left out, as the end of a sentence.
    """
    if num_missing:
        warn(
            f"SA301 {num_missing} of {num_simulations} simulations of the refinement "
            f"are missing, by faults of the simulator; {left_out} were left out",
            MissingRowsWarning,
        )


def rows_of(
    simulator: Callable[..., Any],
    theta: Tensor,
    action: Tensor,
    seed: int,
    workers: Workers,
    *,
    is_first: bool = True,
    batch_size: int | None = None,
) -> Simulations | None:
    """Return simulated rows, those that faults hit among them; None if all are lost.

    Raises:
        SimulationError: If all rows of a first call fail.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MissingRowsWarning)  # they are counted
        try:
            return simulate(
                *(simulator, theta, action),
                seed=seed,
                workers=workers,
                batch_size=batch_size,
            )
        except SimulationError:  # of a few rows, all may be lost
            if is_first:
                raise
            return None
