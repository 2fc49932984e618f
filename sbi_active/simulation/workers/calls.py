"""One call of a simulator: the rows, their random numbers, and what came of them."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from sbi_active.arrays import own_tensor
from sbi_active.expected import require
from sbi_active.seeding import forked_generators
from sbi_active.simulation.model import SimulatorModel
from sbi_active.simulation.simulator import outcome_tensor

#: Rows that share one seed of the global generators. Part of the definition of x for a
#: simulator that takes no seeds, so it is never a setting.
BLOCK = 256

#: Source of the random numbers of a call, see :class:`Call`.
Draws = Literal["seeds", "block", "row"]

Fault = Literal["raised", "timed out", "worker died", "misused", "not loaded"]

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
            "block" and "row" fork the global generators for the rows, a block of 256
            or a single one.
    """

    rows: np.ndarray
    theta: Tensor
    action: Tensor
    seeds: Tensor
    seed: int
    draws: Draws

    def __len__(self) -> int:
        return len(self.rows)


@dataclass(frozen=True, eq=False)
class Reply:
    """The result of a call.

    Attributes:
        x: Outcomes, shape (k, *x_shape), float32; None if there is a fault.
        seconds: Wall time that the simulator took.
        fault: Fault that occurred; None if nothing did.
        traceback: Text that tells it.
    """

    x: Tensor | None = None
    seconds: float = 0.0
    fault: Fault | None = None
    traceback: str = ""


def answer(simulator: Callable[..., Any], call: Call, catches: Any = HERE) -> Reply:
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
        is_misused = _is_of_the_interface(error)
        if is_misused and catches is HERE:
            raise
        fault = "misused" if is_misused else "raised"
        return Reply(fault=fault, traceback=traceback.format_exc())
    return Reply(x, time.perf_counter() - start)


def _draw(simulator: Callable[..., Any], call: Call) -> Tensor:
    theta, action, seeds = call.theta, call.action, call.seeds
    if call.draws == "seeds":
        x = simulator(theta, action, seeds=seeds)
        return outcome_tensor(x, len(theta), dtype=torch.float32)
    is_model = isinstance(simulator, SimulatorModel)
    given = (theta, action, seeds) if is_model else (theta, action)
    with _GENERATORS, forked_generators(call.seed, call.draws, int(call.rows[0])):
        return outcome_tensor(simulator(*given), len(theta), dtype=torch.float32)


def _is_of_the_interface(error: BaseException) -> bool:
    """Return whether our own checks raised it, or the call itself: no fault of a row.

    Such an error comes of arguments that do not fit or of rows of another shape, and
    the innermost frame of its traceback is ours and not the simulator's.
    """
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    names = [frame.f_globals.get("__name__") for frame in frames]
    where = [name for name in names if name != require.__module__][-1]
    if where == __name__:
        return isinstance(error, TypeError)
    return where in _INTERFACE and isinstance(error, ValueError | TypeError)
