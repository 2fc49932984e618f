"""The schedule of a simulation: rows simulated together, and calls that fail."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from sbi_active.arrays import all_finite
from sbi_active.seeding import row_seeds
from sbi_active.simulation.outcomes import Outcome, SimulationError
from sbi_active.simulation.workers.calls import BLOCK, Call, Draws, Reply
from sbi_active.simulation.workers.pace import Pace
from sbi_active.simulation.workers.pools import Pool
from sbi_active.simulation.workers.settings import IN_PROCESS, Workers

_UNFINISHED = -1  # no status of a row that is one

#: Finished rows: index (k,), x (k, *x_shape), status (k,).
Rows = tuple[Tensor, Tensor, Tensor]


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
        theta: Parameters, shape (n, theta_dim).
        action: Actions, shape (n, action_dim).
        seed: Seed of the whole set.
        has_seeds: Whether the simulator takes them.
        batch_size: Rows a call; None measures how many take ``BATCH_SECONDS``.
        pace: Sizes the calls where no batch size is given, as one worker needs it:
            a short simulation is one call, a long one is cut.
        workers: The seconds that a row may take, and how often a missing one is tried
            again.

    Attributes:
        x: Outcomes, shape (n, *x_shape), NaN where there is none; None until a call
            succeeds.
        status: Status of each row, shape (n,), int8, -1 for rows that are not finished.
        tracebacks: Tracebacks of the rows that have failed, though a later attempt may
            have succeeded.
        faults: Numbers of missing rows by fault.
    """

    #: A call is sized to take this long, which hides what sending it costs.
    BATCH_SECONDS = 0.25

    #: Rows lost without a single success before the whole set is probed, and the rows,
    #: evenly spread, that it is probed with.
    NUM_PROBES = 16

    #: Calls that may be simulated again, in one with all others, once they have shown
    #: that the whole takes no longer than a part may.
    MAX_TIMED = 4

    #: A call may take this multiple of the time its rows took before, and the limit of
    #: a row on top, until it is divided: a hanging row then costs its own limit.
    SLACK = 5.0

    def __init__(
        self,
        theta: Tensor,
        action: Tensor,
        *,
        seed: int,
        has_seeds: bool,
        batch_size: int | None = None,
        pace: Pace | None = None,
        workers: Workers = IN_PROCESS,
    ) -> None:
        self.theta, self.action, self.seed = theta, action, seed
        self.seeds, self.has_seeds = row_seeds(seed, len(theta)), has_seeds
        self.batch_size, self.pace, self.workers = batch_size, pace, workers
        self.x: Tensor | None = None
        self.status = torch.full((len(theta),), _UNFINISHED, dtype=torch.int8)
        self.tracebacks: dict[int, str] = {}
        self.faults: Counter[str] = Counter()
        self._urgent: deque[Call] = deque()
        self._attempts: Counter[int] = Counter()
        self._accidents: set[int] = set()  # first rows of blocks whose worker died
        self._seconds_a_row: float | None = None
        self._largest = 16
        self._num_probes = 0  # that have not failed
        self._has_succeeded = False
        self._num_timed = 0  # calls
        self._to_come, self._next = np.arange(len(theta)), 0

    def restore(self, index: Tensor, x: Tensor, status: Tensor) -> int:
        """Take rows as finished that a store holds; return how many."""
        known = (status != Outcome.MISSING).nonzero()[:, 0]  # a fault is tried again
        known = known[index[known].argsort()]  # several workers store them in any order
        index, x, status = index[known], x[known], status[known]
        if len(index):
            self._settle(index, x.to(torch.float32, copy=True), status.to(torch.int8))
            self._has_succeeded = True
        return len(index)

    def run(self, pool: Pool) -> Iterator[Rows]:
        """Simulate what is not finished, and yield rows as they are.

        Args:
            pool: Pool that runs the calls.

        Raises:
            SimulationError: If no row can be simulated.
            ValueError: If the simulator returns another shape than its rows'.
        """
        to_come = (self.status == _UNFINISHED).numpy()
        if not self.has_seeds:  # whole blocks
            of_block = np.arange(len(to_come)) // BLOCK
            to_come = np.isin(of_block, of_block[to_come])
        self._to_come, self._next = np.flatnonzero(to_come), 0
        num_running = 0
        while True:
            while num_running < pool.num_slots and (call := self._next_call(pool)):
                pool.submit(call, self._limit(call))
                num_running += 1
            if not num_running:
                return
            for call, reply in pool.finished():
                num_running -= 1
                rows = self._receive(call, reply)
                if rows is not None:
                    yield rows

    def _next_call(self, pool: Pool) -> Call | None:
        while self._urgent:
            call = self._urgent.popleft()
            if call.is_probe or (self.status[call.rows] == _UNFINISHED).any():
                return call
        if self._next == len(self._to_come):
            return None
        size = self._size(len(self._to_come) - self._next, pool.num_slots)
        rows = self._to_come[self._next : self._next + size]
        self._next += len(rows)
        return self._call(rows, "seeds" if self.has_seeds else "blocks")

    def _call(self, rows: np.ndarray, draws: Draws, is_probe: bool = False) -> Call:
        at: slice | Tensor = torch.from_numpy(rows)
        if len(rows) == rows[-1] - rows[0] + 1:  # a view costs nothing
            at = slice(int(rows[0]), int(rows[-1]) + 1)
        theta, action, seeds = self.theta[at], self.action[at], self.seeds[at]
        return Call(rows, theta, action, seeds, self.seed, draws, is_probe)

    def _size(self, num_left: int, num_slots: int) -> int:
        """Return the rows of the next call; this never changes x."""
        if self.batch_size is not None:
            size = self.batch_size
        elif self.pace is not None:
            size = self.pace.size(num_left)
        else:
            # The last calls are small, so that all workers end together.
            size = min(self._largest, -(-num_left // (2 * num_slots)))
            if self._seconds_a_row is not None:
                timely = int(self.BATCH_SECONDS / max(self._seconds_a_row, 1e-9))
                size = max(min(timely, size), 1)
        return size if self.has_seeds else -(-size // BLOCK) * BLOCK

    def _limit(self, call: Call) -> float | None:
        row_limit = self.workers.time_limit
        if row_limit is None:
            return None
        limit = row_limit * len(call)
        if call.draws == "seeds" and self._seconds_a_row is not None:
            usual = self._seconds_a_row * len(call)
            limit = min(limit, row_limit + self.SLACK * usual)
        return limit

    def _receive(self, call: Call, reply: Reply) -> Rows | None:
        """Return the rows that a call has finished, if any."""
        if reply.fault == "misused":
            if reply.error is not None:
                raise reply.error
            last_line = reply.traceback.strip().splitlines()[-1]
            raise ValueError(f"{last_line}; in a worker:\n{reply.traceback}")
        if reply.fault == "not loaded":
            raise SimulationError(
                "expected a simulator that a worker process can load; got\n"
                f"{reply.traceback}\nmake its module importable there, or simulate "
                "without workers="
            )
        if reply.x is None:
            self._fail(call, reply)
            return None
        self._has_succeeded = True
        if call.is_probe:
            return None
        self._seconds_a_row = reply.seconds / len(call)
        self._largest = max(self._largest, 8 * len(call))
        if self.pace is not None and call.draws != "alone":
            self.pace.observe(len(call), reply.seconds)
            self._num_timed += 1
            if self._is_short_after_all(self.pace):
                # What is known of its pace must make no difference to a simulator that
                # rounds otherwise in a batch of another size: all rows are one call.
                self.status[torch.from_numpy(self._to_come[: self._next])] = _UNFINISHED
                self.x, self._next = None, 0
                return None
        return self._take(call, reply.x)

    def _is_short_after_all(self, pace: Pace) -> bool:
        """Return whether the few rows that were timed show that one call will do."""
        is_timing = self.has_seeds and self._num_timed <= self.MAX_TIMED
        is_clean = not (self._urgent or self.tracebacks)
        is_part = self._next < len(self._to_come)
        return is_timing and is_clean and is_part and pace.is_short(len(self._to_come))

    def _take(self, call: Call, x: Tensor) -> Rows:
        index = torch.from_numpy(call.rows)
        status = torch.full((len(x),), Outcome.OK, dtype=torch.int8)
        if not all_finite(x):
            finite = x.isfinite()
            x = x.masked_fill(~finite, torch.nan)
            status[~finite.flatten(1).any(-1).cpu()] = Outcome.INVALID
        fresh = self.status[index] == _UNFINISHED
        if not bool(fresh.all()):
            index, x, status = index[fresh], x[fresh.to(x.device)], status[fresh]
        self._settle(index, x, status)
        return index, x, status

    def _settle(self, index: Tensor, x: Tensor, status: Tensor) -> None:
        n = len(self.status)
        if self.x is not None and x.shape[1:] != self.x.shape[1:]:
            raise ValueError(
                "expected x of one shape a row; got "
                f"{tuple(self.x.shape[1:])} and {tuple(x.shape[1:])}, the latter in "
                f"rows {index[:3].tolist()}...; pad trajectories with NaN, which "
                "masks them"
            )
        if self.x is None and len(index) == n:
            self.x = x
        else:
            if self.x is None:
                self.x = x.new_full((n, *x.shape[1:]), torch.nan)
            self.x[index.to(x.device)] = x
        self.status[index] = status

    def _fail(self, call: Call, reply: Reply) -> None:
        """Divide a call that failed; a single row is tried again, or lost."""
        is_block = call.draws == "blocks" and len(call) <= BLOCK
        has_died = reply.fault == "worker died"
        if call.is_probe:
            self._num_probes -= 1
            if not (self._num_probes or self._has_succeeded):
                self._give_up(reply)
            return
        if is_block and has_died and call.rows[0] not in self._accidents:
            self._accidents.add(call.rows[0])  # x must be as without one
            parts = [call]
        elif is_block:
            parts = call.parts(1, draws="alone")
        elif call.draws == "blocks":
            parts = call.parts(BLOCK)
        elif len(call) > 1:
            parts = call.parts(-(-len(call) // (2 if reply.fault == "raised" else 16)))
        else:
            self._lose(call, reply)
            return
        self._urgent.extendleft(reversed(parts))

    def _lose(self, call: Call, reply: Reply) -> None:
        row = int(call.rows[0])
        self.tracebacks.setdefault(row, reply.traceback)
        self._attempts[row] += 1
        if self._attempts[row] <= self.workers.num_retries:
            self._urgent.append(call)
            return
        self.status[row] = Outcome.MISSING
        self.faults[reply.fault or "raised"] += 1
        if self._has_succeeded:
            return
        if not bool((self.status == _UNFINISHED).any()):
            self._give_up(reply)
        if not self._num_probes and len(self.tracebacks) >= self.NUM_PROBES:
            spread = np.linspace(0, len(self.status) - 1, self.NUM_PROBES)
            rows = np.unique(spread.round().astype(np.int64))
            draws: Draws = "seeds" if self.has_seeds else "alone"
            self._num_probes = len(rows)
            self._urgent.extendleft(self._call(r, draws, True) for r in rows[:, None])

    def _give_up(self, reply: Reply) -> None:
        first = next(iter(self.tracebacks.values()))
        raise SimulationError(
            "expected a simulator that can simulate; got a fault in each of the "
            f"{len(self.tracebacks)} rows tried, so no row is to blame; mend the "
            "simulator, or wrap a function of one row, SimulatorModel(fn, "
            f"batched=False). The first of them:\n{first}"
        ) from reply.error
