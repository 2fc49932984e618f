"""One call of a simulator: the rows, their random numbers, and what came of them."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from sbi_active.arrays import own_tensor
from sbi_active.seeding import forked_generators
from sbi_active.simulation.model import SimulatorModel
from sbi_active.simulation.simulator import outcome_tensor

#: Rows that share one seed of the global generators. Part of the definition of x for a
#: simulator that takes no seeds, so it is never a setting.
BLOCK = 256

#: Source of the random numbers of a call, see :class:`Call`.
Draws = Literal["seeds", "blocks", "alone"]

Fault = Literal["raised", "timed out", "worker died", "gone", "misused", "not loaded"]

#: What is caught in the user's process, where an interrupt means the whole program.
HERE = (Exception, SystemExit)

_INTERFACE = {m.__module__ for m in (SimulatorModel, outcome_tensor, own_tensor)}

# The generators of torch and NumPy belong to the process, and some executors run
# several calls in threads of one.
_GENERATORS = threading.RLock()


@dataclass(frozen=True, eq=False)
class Call:
    """Rows to simulate in one call.

    Attributes:
        rows: Indices of the rows in the whole set, shape (k,), int64.
        theta: Parameters, shape (k, theta_dim).
        action: Actions, shape (k, action_dim).
        seeds: Seeds, one a row, shape (k,), int64.
        seed: Seed of the whole set.
        draws: Source of the random numbers: "seeds" passes those to the simulator;
            "blocks" forks the global generators for each block of 256 rows, and the
            rows are whole blocks; "alone" forks them for the single row.
        is_probe: Whether it only asks if the simulator works, its x being dropped.
    """

    rows: np.ndarray
    theta: Tensor
    action: Tensor
    seeds: Tensor
    seed: int
    draws: Draws
    is_probe: bool = False

    def __len__(self) -> int:
        return len(self.rows)

    def parts(self, size: int, **changes: Any) -> list[Call]:
        """Return calls of so many of the rows each."""
        rows = [slice(i, i + size) for i in range(0, len(self), size)]
        names = "rows", "theta", "action", "seeds"
        return [
            replace(self, **{n: getattr(self, n)[part] for n in names}, **changes)
            for part in rows
        ]


@dataclass(frozen=True, eq=False)
class Reply:
    """The result of a call.

    Attributes:
        x: Outcomes, shape (k, *x_shape), float32; None if there is a fault.
        seconds: Wall time that the simulator took.
        fault: Fault that occurred; None if nothing did.
        traceback: Text that tells it.
        error: The exception itself, where it was raised in this process.
    """

    x: Tensor | None = None
    seconds: float = 0.0
    fault: Fault | None = None
    traceback: str = ""
    error: BaseException | None = field(default=None, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        # An exception may be impossible to pickle; its text has been taken.
        return {**vars(self), "error": None}


def answer(
    simulator: Callable[..., Any],
    call: Call,
    *,
    catches: type[BaseException] | tuple[type[BaseException], ...] = HERE,
) -> Reply:
    """Run the simulator over the rows of a call; its exceptions become a reply.

    Args:
        simulator: Simulator that takes theta, the action, and seeds where the call says
            so.
        call: The rows.
        catches: Exceptions that become a reply. All of them in a process that serves
            calls alone, where nobody else would tell what was raised.
    """
    start = time.perf_counter()
    try:
        x = _draw(simulator, call)
    except catches as error:
        fault = "misused" if _is_of_the_interface(error) else "raised"
        return Reply(None, 0.0, fault, traceback.format_exc(), error)
    return Reply(x, time.perf_counter() - start)


def _draw(simulator: Callable[..., Any], call: Call) -> Tensor:
    # A simulator may change its arguments in place; those of the call are tried again.
    theta, action, seeds = call.theta.clone(), call.action.clone(), call.seeds.clone()
    if call.draws == "seeds":
        x = simulator(theta, action, seeds=seeds)
        return outcome_tensor(x, len(theta), dtype=torch.float32)
    kind = "block" if call.draws == "blocks" else "row"
    x = torch.empty(0)
    for start in range(0, len(call), BLOCK):
        rows = slice(start, start + BLOCK)
        given = theta[rows], action[rows]
        if isinstance(simulator, SimulatorModel):
            given = *given, seeds[rows]
        with _GENERATORS, forked_generators(call.seed, kind, int(call.rows[start])):
            part = simulator(*given)
            # Copied before the simulator fills its buffer again.
            part = outcome_tensor(part, len(theta[rows]), dtype=torch.float32)
        if not start:
            x = part.new_empty((len(call), *part.shape[1:]))
        if part.shape[1:] != x.shape[1:]:
            raise ValueError(
                "expected x of one shape a row; got "
                f"{tuple(x.shape[1:])} and {tuple(part.shape[1:])}; pad trajectories "
                "with NaN, which masks them"
            )
        x[rows] = part
    return x


def _is_of_the_interface(error: BaseException) -> bool:
    """Return whether our own checks raised it, or the call itself: no fault of a row.

    Such an error comes of arguments that do not fit or of rows of another shape, and
    the innermost frame of its traceback is ours and not the simulator's.
    """
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    where = trace.tb_frame.f_globals.get("__name__") if trace is not None else None
    if where == __name__:
        return isinstance(error, TypeError)
    return where in _INTERFACE and isinstance(error, ValueError | TypeError)
