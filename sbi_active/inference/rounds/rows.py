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

from sbi_active.arrays import finite
from sbi_active.expected import require
from sbi_active.inference.rounds.condition import action_rows, outcome_rows
from sbi_active.messages import Explained, warn
from sbi_active.simulation.outcomes import (
    MissingRowsWarning,
    SimulationError,
    Simulations,
)
from sbi_active.simulation.workers.engine import simulate
from sbi_active.simulation.workers.settings import Workers
from sbi_active.support import parameter_dim, within_support


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


def round_rows(
    theta: Tensor,
    x: Tensor,
    action: Tensor,
    *,
    prior: Distribution,
    x_shape: torch.Size | None,
    action_dim: int | None,
    exclude_invalid: bool,
    may_be_invalid: bool = False,
) -> Simulations:
    """Return the rows of a round in float32, or say what is wrong with them.

    Outcomes may be gigabytes: who keeps them makes a copy.

    Args:
        theta: Parameters, shape (n, theta_dim), within the prior's support.
        x: Outcomes, shape (n, *x_shape), or (n,) where x is one number.
        action: Actions, shape (n, action_dim), or (action_dim,) for all rows.
        prior: Prior that gives theta_dim and the support.
        x_shape: Shape of earlier outcomes; None takes that of these.
        action_dim: Dimension of earlier actions; None takes that of these.
        exclude_invalid: Drop rows in which a number is missing.
        may_be_invalid: Whether it is plausible that no row has a measurement, as under
            a belief from trials that had none.

    Raises:
        ValueError: If shapes do not fit, theta leaves the support, or no row is valid.
    """
    theta = torch.as_tensor(theta, dtype=torch.float32).clone()
    x = torch.as_tensor(x)
    x = x[:, None] if x.ndim == 1 else x
    dim = parameter_dim(prior)
    require(
        theta.ndim == 2 and theta.shape[1] == dim and len(x) == len(theta),
        f"theta (n, {dim}) and x (n, ...) with as many rows",
        f"{tuple(theta.shape)} and {tuple(x.shape)}",
        "give one row a simulation",
    )
    outside = ~within_support(prior, theta)
    if bool(outside.any()):
        row = int(outside.nonzero()[0])
        raise ValueError(
            f"expected theta within the prior's support; got {int(outside.sum())} of "
            f"{len(theta)} rows outside, the first {theta[row].tolist()} in row {row}; "
            "sample theta from the belief"
        )
    x = outcome_rows(x, x.shape[1:] if x_shape is None else x_shape, copy=False)
    action = action_rows(action, action_dim, num_rows=len(theta))
    rows = Simulations(theta, action, x)
    present = finite(x.flatten(1))
    invalid = ~(present.all(-1) if exclude_invalid else present.any(-1))
    if bool(invalid.all()) and (exclude_invalid or not may_be_invalid):
        raise UnexplainedOutcomeError(
            f"expected at least one simulation with a measurement; got {len(x)} of "
            f"{len(x)} invalid (NaN or inf); check the simulator at theta = "
            f"{theta[0].tolist()}, action = {action[0].tolist()}"
        )
    if not (exclude_invalid and bool(invalid.any())):
        return rows
    warn(
        f"SA302 dropping {int(invalid.sum())} of {len(x)} simulations without a "
        "measurement: information gain is then biased towards actions that fail. The "
        "default MixtureDensity network keeps them."
    )
    return rows.at(~invalid)


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
