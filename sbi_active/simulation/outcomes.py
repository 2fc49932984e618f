"""Outcomes of simulated rows: a measurement, none, or a fault."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import torch
from torch import Tensor

from sbi_active.arrays import finite
from sbi_active.messages import Explained, SimulationWarning


class Outcome(IntEnum):
    """Outcome of a row.

    Attributes:
        OK: A measurement; some of its numbers may be NaN, which masks them.
        INVALID: The system ran and gave no measurement (it fell off the table): NaN
            throughout, information about the parameters, and so a part of x.
        MISSING: A fault unrelated to the parameters (an exception, a time-out, a lost
            worker): NaN throughout, and ignored.
    """

    OK = 0
    INVALID = 1
    MISSING = 2


@dataclass(frozen=True)
class Simulations:
    """Simulated outcomes, one a row.

    Attributes:
        theta: Parameters, shape (n, theta_dim).
        action: Actions, shape (n, action_dim).
        x: Outcomes, shape (n, *x_shape), float32; NaN where there is no measurement.
        status: An :class:`Outcome` a row, shape (n,), int8; None reads it from x, NaN
            throughout being invalid.
        tracebacks: Tracebacks of the rows that failed, by index.
    """

    theta: Tensor
    action: Tensor
    x: Tensor
    status: Tensor = None  # type: ignore[assignment]  # filled in below
    tracebacks: dict[int, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.status is None:
            lost = ~finite(self.x.flatten(1)).any(-1)
            object.__setattr__(self, "status", lost.to(torch.int8))

    @property
    def valid(self) -> Tensor:
        """Rows with a measurement, shape (n,), bool."""
        return self.status == Outcome.OK

    @property
    def counts(self) -> dict[str, int]:
        """Number of rows by outcome."""
        return {o.name.lower(): int((self.status == o).sum()) for o in Outcome}

    def __repr__(self) -> str:
        parts = ("theta", self.theta), ("action", self.action), ("x", self.x)
        shapes = [f"{name} {tuple(part.shape[1:])}" for name, part in parts]
        counts = [f"{num} {name}" for name, num in self.counts.items() if num]
        return f"Simulations({', '.join(shapes)}: {', '.join(counts) or 'none'})"

    def __len__(self) -> int:
        return len(self.theta)

    def at(self, mask: Tensor) -> Simulations:
        """Return some rows, by a mask of shape (n,), without tracebacks."""
        each = self.action[mask], self.x[mask], self.status[mask]
        return Simulations(self.theta[mask], *each)

    def without_missing(self) -> Simulations:
        """Return the rows that tell something: those not missing."""
        keep = self.status != Outcome.MISSING
        return self if bool(keep.all()) else self.at(keep)


class SimulationError(Explained, RuntimeError):
    """No row could be simulated, or the simulator could not be loaded in a worker."""

    code = "SA307"


class SimulationInterrupted(Explained, KeyboardInterrupt):
    """The user interrupted a simulation.

    Attributes:
        simulations: Simulations that are finished; the other rows are missing.
    """

    code = "SA308"

    def __init__(self, simulations: Simulations) -> None:
        counts = ", ".join(f"{k} {name}" for name, k in simulations.counts.items())
        super().__init__(f"simulation interrupted: {counts}")
        self.simulations = simulations


class MissingRowsWarning(SimulationWarning):
    """Some rows are missing; the others stand."""
