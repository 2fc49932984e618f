"""The schedule of a simulation: rows simulated together, and calls that fail."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator
from math import inf, nan
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from sbi_active.arrays import all_finite
from sbi_active.seeding import row_seeds
from sbi_active.simulation.model import takes_seeds
from sbi_active.simulation.outcomes import Outcome, SimulationError, Simulations
from sbi_active.simulation.workers.calls import BLOCK, Call, Draws, Reply
from sbi_active.simulation.workers.pools import Pool
from sbi_active.simulation.workers.settings import IN_PROCESS, Workers

_UNFINISHED = -1  # no status of a row that is one


class Pace:
    """Time that a call of a simulator took, by which the next one is sized.

    A call cannot be interrupted without losing its rows, so a long simulation is cut
    into parts of a second. A vectorized simulator takes as long for few rows as for
    many: as long as more rows take hardly more time, the next call has many more.

    Example:
        >>> pace = Pace()
        >>> pace.size(2_000)  # nothing is known
        2
        >>> pace.observe(2, 0.02)
        >>> pace.size(1_998)  # not 100 yet, since two rows say little of many
        32
        >>> pace.is_short(100)
        True
    """

    #: A part is sized to take this long; what takes half as long again is not cut.
    SECONDS = 1.0

    #: Rows of a call at least. A single one is a shape that simulators may not expect.
    LEAST = 2

    #: Multiple of its rows that follows a call at most, and at least where more rows
    #: take hardly more time.
    GROWTH = 16

    def __init__(self) -> None:
        self._rows, self._seconds, self._growth = 1, inf, 2  # which compares two calls

    def observe(self, num_rows: int, seconds: float) -> None:
        """Take the time of a call."""
        if num_rows >= 2 * self._rows:
            ratio = seconds / self._seconds
            # Fewer rows that took longer had something to load or to compile.
            self._growth = 2 if ratio < 0.8 else self.GROWTH if ratio < 1.5 else 0
        if 2 * num_rows >= self._rows:
            self._rows, self._seconds = num_rows, max(seconds, 1e-9)

    def seconds(self, num_rows: int) -> float:
        """Return the seconds that rows take at most; infinite before any call."""
        return self._seconds * max(num_rows / self._rows, 1.0)

    def is_short(self, num_rows: int) -> bool:
        """Return whether rows take too little time to be cut."""
        return self.seconds(num_rows) <= 1.5 * self.SECONDS

    def size(self, num_left: int) -> int:
        """Return the rows of the next call, of those that are left."""
        if self.is_short(num_left):
            return num_left
        timely = self.SECONDS * self._rows / self._seconds
        size = max(min(timely, self.GROWTH * self._rows), self._growth * self._rows)
        size = max(int(size), self.LEAST)
        return size if num_left - size >= self.LEAST else num_left


# What is known is kept, so that only the first simulation has to find out.
_PACES: WeakKeyDictionary[Any, Pace] = WeakKeyDictionary()


def pace_of(simulator: Callable[..., Any]) -> Pace:
    """Return the pace of a simulator, or of the object whose method it is."""
    try:
        return _PACES.setdefault(getattr(simulator, "__self__", simulator), Pace())
    except TypeError:  # it has no hash, or takes no weak reference
        return Pace()


class Schedule:
    """The rows of a simulation on their way through a pool.

    A call that raises is halved until the guilty rows are alone. One that dies or
    exceeds its time is divided into sixteen, since each of those costs a worker or
    the time limit, whereas good rows cost little. A row that fails alone is missing.

    A simulator that takes no seeds draws the random numbers of 256 rows from one
    stream, so its blocks stay whole until one fails, and then each of its rows is
    given a stream of its own. After a death it is first tried again, in case that was
    an accident.

    Args:
        simulator: Simulator of the rows, which a pool runs.
        theta: Parameters, shape (n, theta_dim).
        action: Actions, shape (n, action_dim).
        seed: Seed of the whole set.
        workers: The seconds that a row may take, and how often a missing one is tried
            again.
        batch_size: Rows a call; None takes those of the simulator's pace.
        starts_over: Whether rows that were timed are simulated again in one call with
            all others, where that is short. A simulator that rounds otherwise in a
            batch of another size then has the same x whatever is known of its pace.

    Attributes:
        x: Outcomes, shape (n, *x_shape), NaN where there is none; None until a call
            succeeds.
        status: Status of each row, shape (n,), int8, -1 for rows that are not finished.
        lost: Replies to the calls of missing rows, each alone.
    """

    #: Rows lost without a single success that show that no row is to blame.
    NUM_TRIED = 64

    #: A call may take this multiple of the time its rows took before, and the limit of
    #: a row on top, until it is divided: a hanging row then costs its own limit.
    SLACK = 5.0

    def __init__(
        self,
        simulator: Callable[..., Any],
        theta: Tensor,
        action: Tensor,
        seed: int,
        *,
        workers: Workers = IN_PROCESS,
        batch_size: int | None = None,
        starts_over: bool = False,
    ) -> None:
        self.theta, self.action, self.seed = theta, action, seed
        self.x: Tensor | None = None
        self.status = torch.full((len(theta),), _UNFINISHED, dtype=torch.int8)
        self.lost: dict[int, Reply] = {}
        self._workers, self._batch_size = workers, batch_size
        self._has_seeds, self._pace = takes_seeds(simulator), pace_of(simulator)
        self._may_start_over = starts_over and self._has_seeds and batch_size is None
        self._seeds = row_seeds(seed, len(theta))
        self._urgent: deque[Call] = deque()
        self._attempts: Counter[tuple[str, int, int]] = Counter()

    def restore(self, stored: tuple[Tensor, Tensor, Tensor] | None) -> None:
        """Take rows as finished, if a store has any: index, x, status, in any order."""
        index, x, status = stored or (torch.empty(0),) * 3
        order = index.argsort()
        known = order[status[order] != Outcome.MISSING]  # a fault is tried again
        if len(known):
            self._take(index[known], x[known].float())

    def run(self, pool: Pool) -> Iterator[int]:
        """Simulate what is not finished; yield the numbers of rows that finish.

        Args:
            pool: Pool that runs the calls.

        Raises:
            SimulationError: If no row can be simulated.
            ValueError: If the simulator returns another shape than its rows'.
        """
        to_come = (self.status == _UNFINISHED).numpy()
        if not self._has_seeds:  # whole blocks
            of_block = np.arange(len(to_come)) // BLOCK
            to_come = np.isin(of_block, of_block[to_come])
        self._to_come = np.flatnonzero(to_come)
        num_running = 0
        while True:
            while num_running < pool.num_slots and (call := self._next_call(pool)):
                pool.submit(call, self._limit(call))
                num_running += 1
            if not num_running:
                return
            for call, reply in pool.finished():
                num_running -= 1
                if reply.x is None:
                    self._fail(call, reply)
                elif not self._starts_over(call, reply):
                    yield self._take(torch.from_numpy(call.rows), reply.x)

    def rows(self) -> Simulations:
        """Return the rows, those that are not finished as missing."""
        assert self.x is not None
        status = self.status.masked_fill(self.status < 0, Outcome.MISSING)
        tracebacks = {row: self.lost[row].traceback for row in sorted(self.lost)}
        return Simulations(self.theta, self.action, self.x, status, tracebacks)

    def _next_call(self, pool: Pool) -> Call | None:
        while self._urgent:
            call = self._urgent.popleft()
            if (self.status[call.rows] == _UNFINISHED).any():
                return call
        if not (num_left := len(self._to_come)):
            return None
        # With several workers the last calls are small, so that all end together.
        share = -(-num_left // (2 * pool.num_slots)) if pool.num_slots > 1 else num_left
        size = self._batch_size or min(self._pace.size(num_left), share)
        size = size if self._has_seeds else BLOCK
        rows, self._to_come = self._to_come[:size], self._to_come[size:]
        return self._call(rows, "seeds" if self._has_seeds else "block")

    def _call(self, rows: np.ndarray, draws: Draws) -> Call:
        # Copies, which a simulator may change.
        theta, action, seeds = self.theta[rows], self.action[rows], self._seeds[rows]
        return Call(rows, theta, action, seeds, self.seed, draws)

    def _limit(self, call: Call) -> float | None:
        row_limit = self._workers.time_limit
        if row_limit is None or call.draws != "seeds":
            return row_limit and row_limit * len(call)
        usual = self._pace.seconds(len(call))
        return min(row_limit * len(call), row_limit + self.SLACK * usual)

    def _starts_over(self, call: Call, reply: Reply) -> bool:
        """Take the time of a call; drop all rows if they will do in one call."""
        if call.draws == "seeds":
            self._pace.observe(len(call), reply.seconds)
        is_clean = not (self._urgent or self.lost) and len(self._to_come) > 0
        is_short = self._pace.is_short(len(self.status))
        starts_over = self._may_start_over and is_clean and is_short
        if starts_over:
            self.x, self._to_come = None, np.arange(len(self.status))
            self.status.fill_(_UNFINISHED)
        return starts_over

    def _take(self, index: Tensor, x: Tensor) -> int:
        """Take outcomes of rows; return how many had none before."""
        fresh = self.status[index] == _UNFINISHED
        if not bool(fresh.all()):
            index, x = index[fresh], x[fresh.to(x.device)]
        status = torch.full((len(x),), Outcome.OK, dtype=torch.int8)
        if not all_finite(x):
            finite = x.isfinite()
            x = x.masked_fill(~finite, nan)
            status[~finite.flatten(1).any(-1).cpu()] = Outcome.INVALID
        shape = x.shape if self.x is None else self.x.shape
        if x.shape[1:] != shape[1:]:
            raise ValueError(
                f"expected x of one shape a row; got {tuple(shape[1:])} and "
                f"{tuple(x.shape[1:])}; pad trajectories with NaN, which masks them"
            )
        if self.x is None and len(index) == len(self.status):
            self.x = x
        else:
            if self.x is None:
                self.x = x.new_full((len(self.status), *x.shape[1:]), nan)
            self.x[index.to(x.device)] = x
        self.status[index] = status
        return len(index)

    def _fail(self, call: Call, reply: Reply) -> None:
        """Try a call that failed again, divide it, or lose its row."""
        if reply.fault == "not loaded":
            raise SimulationError(
                "expected a simulator that a worker process can load; got\n"
                f"{reply.traceback}\nmake its module importable there, or simulate "
                "without workers="
            )
        if reply.fault == "misused":
            last_line = reply.traceback.strip().splitlines()[-1]
            raise ValueError(f"{last_line}; in a worker:\n{reply.traceback}")
        row, is_block = int(call.rows[0]), call.draws == "block"
        is_row = len(call) == 1 and not is_block
        # After an accident x of a block is as without one.
        is_accident = is_block and reply.fault == "worker died"
        num_retries = self._workers.num_retries if is_row else int(is_accident)
        attempt = call.draws, len(call), row
        self._attempts[attempt] += 1
        if self._attempts[attempt] <= num_retries:
            self._urgent.append(self._call(call.rows, call.draws))
        elif is_row:
            self.lost[row], self.status[row] = reply, Outcome.MISSING
        else:
            num_parts = len(call) if is_block else 2 if reply.fault == "raised" else 16
            parts = np.array_split(call.rows, min(num_parts, len(call)))
            draws: Draws = "row" if is_block else "seeds"
            self._urgent.extendleft(self._call(rows, draws) for rows in reversed(parts))
        num_lost = len(self.lost)
        if self.x is None and num_lost in (self.NUM_TRIED, len(self.status)):
            first = next(iter(self.lost.values())).traceback
            raise SimulationError(
                "expected a simulator that can simulate; got a fault in each of the "
                f"{num_lost} rows tried, so no row is to blame; mend the simulator, or "
                "wrap a function of one row, SimulatorModel(fn, batched=False). The "
                f"first of them:\n{first}"
            )
