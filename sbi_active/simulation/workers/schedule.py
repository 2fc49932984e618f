"""The schedule of a simulation: rows simulated together, and calls that fail."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from sbi_active.arrays import all_finite
from sbi_active.seeding import row_seeds
from sbi_active.simulation.outcomes import Outcome, SimulationError
from sbi_active.simulation.workers.calls import BLOCK, Call, Reply
from sbi_active.simulation.workers.pace import Pace
from sbi_active.simulation.workers.pools import Pool
from sbi_active.simulation.workers.settings import IN_PROCESS, Workers

_UNFINISHED = -1  # no status of a row that is one


class Schedule:
    """The rows of a simulation on their way through a pool.

    A call that raises is halved until the guilty rows are alone. One that dies or
    exceeds its time is divided into sixteen, since each of those costs a worker or
    the time limit, whereas good rows cost little. A row that fails alone is missing.

    A simulator that takes no seeds draws the random numbers of 256 rows from one
    stream, so its blocks stay whole until one fails, and then each of its rows is
    given a stream of its own. After a death it is first tried again, in case that was
    an accident. Where a pool cannot tell which call killed a worker, that happens last
    and without company.

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
        on_rows: Function that is told about finished rows: index (k,), x (k, *x_shape),
            status (k,).

    Attributes:
        x: Outcomes, shape (n, *x_shape), NaN where there is none; None until a call
            succeeds.
        status: Status of each row, shape (n,), int8, -1 for rows that are not finished.
        tracebacks: Tracebacks of the missing rows.
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
        on_rows: Callable[[Tensor, Tensor, Tensor], None] | None = None,
    ) -> None:
        self.theta = theta
        self.action = action
        self.seeds = row_seeds(seed, len(theta))
        self.seed = seed
        self.has_seeds = has_seeds
        self.batch_size = batch_size
        self.pace = pace
        self.workers = workers
        self.on_rows = on_rows
        self.x: Tensor | None = None
        self.status = torch.full((len(theta),), _UNFINISHED, dtype=torch.int8)
        self.tracebacks: dict[int, str] = {}
        self.faults: Counter[str] = Counter()
        self._urgent: deque[Call] = deque()
        self._suspects: deque[Call] = deque()
        self._attempts: Counter[int] = Counter()
        self._seconds_a_row: float | None = None
        self._largest = 16
        self._num_probing: int | None = None
        self._has_succeeded = False
        self._next = 0  # position in the rows to come
        self._num_timed = 0  # calls

    def restore(self, index: Tensor, x: Tensor, status: Tensor) -> int:
        """Take rows as finished that a store holds; return how many."""
        known = (status != Outcome.MISSING).nonzero()[:, 0]  # a fault is tried again
        known = known[index[known].argsort()]  # several workers store them in any order
        index, x, status = index[known], x[known], status[known]
        if len(index):
            self._settle(index, x.to(torch.float32, copy=True), status.to(torch.int8))
            self._has_succeeded = True
        return len(index)

    def run(self, pool: Pool) -> None:
        """Simulate what is not finished.

        Raises:
            SimulationError: If no row can be simulated.
            ValueError: If the simulator returns another shape than its rows'.
        """
        to_come = (self.status == _UNFINISHED).numpy()
        if not self.has_seeds:  # whole blocks
            of_block = np.arange(len(to_come)) // BLOCK
            to_come = np.isin(of_block, of_block[to_come])
        self._to_come = np.flatnonzero(to_come)
        self._next = 0
        self._num_running = 0
        self._knows_guilty = pool.knows_guilty
        while True:
            while pool.num_free and (call := self._next_call(pool)) is not None:
                pool.submit(call, self._limit(call))
                self._num_running += 1
            if not self._num_running:
                return
            for call, reply in pool.collect():
                self._num_running -= 1
                self._receive(call, reply)

    def _next_call(self, pool: Pool) -> Call | None:
        while self._urgent:
            call = self._urgent.popleft()
            if call.is_probe or (self.status[call.rows] == _UNFINISHED).any():
                return call
        if self._next == len(self._to_come):
            if self._suspects and not self._num_running:
                return self._suspects.popleft()
            return None
        size = self._size(len(self._to_come) - self._next, pool)
        rows = self._to_come[self._next : self._next + size]
        self._next += len(rows)
        return self._call(rows, "seeds" if self.has_seeds else "blocks")

    def _call(
        self,
        rows: np.ndarray,
        draws: Literal["seeds", "blocks", "alone"],
        is_probe: bool = False,
    ) -> Call:
        at: slice | Tensor = torch.from_numpy(rows)
        if len(rows) == rows[-1] - rows[0] + 1:  # a view costs nothing
            at = slice(int(rows[0]), int(rows[-1]) + 1)
        theta, action, seeds = self.theta[at], self.action[at], self.seeds[at]
        return Call(rows, theta, action, seeds, self.seed, draws, is_probe)

    def _size(self, num_left: int, pool: Pool) -> int:
        """Return the rows of the next call; this never changes x."""
        if self.batch_size is not None:
            size = self.batch_size
        elif self.pace is not None:
            size = self.pace.size(num_left)
        else:
            # The last calls are small, so that all workers end together.
            fair = -(-num_left // (2 * pool.num_slots))
            if self._seconds_a_row is None:
                size = min(self._largest, fair)
            else:
                timely = int(self.BATCH_SECONDS / max(self._seconds_a_row, 1e-9))
                size = max(min(timely, fair, self._largest), 1)
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

    def _receive(self, call: Call, reply: Reply) -> None:
        if reply.fault == "misused":
            if reply.error is not None:
                raise reply.error
            raise ValueError(f"{_last_line(reply)}; in a worker:\n{reply.traceback}")
        if reply.fault == "not loaded":
            raise SimulationError(
                "expected a simulator that a worker process can load; got\n"
                f"{reply.traceback}\nmake its module importable there, or simulate "
                "without workers="
            )
        if call.is_probe:
            assert self._num_probing is not None
            self._num_probing -= 1
        if reply.x is None:
            self._fail(call, reply)
            return
        self._has_succeeded = True
        if call.is_probe:
            return
        self._seconds_a_row = reply.seconds / len(call)
        self._largest = max(self._largest, 8 * len(call))
        if self.pace is not None and call.draws != "alone":
            self.pace.observe(len(call), reply.seconds)
            self._num_timed += 1
            if self._is_short_after_all(self.pace):
                self._start_over()
                return
        self._take(call, reply.x)

    def _is_short_after_all(self, pace: Pace) -> bool:
        """Return whether the few rows that were timed show that one call will do."""
        is_timing = self.has_seeds and self._num_timed <= self.MAX_TIMED
        is_clean = not (self._urgent or self.tracebacks)
        is_part = self._next < len(self._to_come)
        return is_timing and is_clean and is_part and pace.is_short(len(self._to_come))

    def _start_over(self) -> None:
        """Forget the rows that were timed, so that x is that of one call.

        A simulator may round otherwise in a batch of another size; what is known of
        its pace must make no difference.
        """
        self.status[torch.from_numpy(self._to_come[: self._next])] = _UNFINISHED
        self.x = None
        self._next = 0

    def _take(self, call: Call, x: Tensor) -> None:
        if all_finite(x):
            status = torch.full((len(x),), Outcome.OK, dtype=torch.int8)
        else:
            finite = x.isfinite()
            x = x.masked_fill(~finite, torch.nan)
            measured = finite.flatten(1).any(-1).cpu()
            status = torch.where(measured, Outcome.OK, Outcome.INVALID).to(torch.int8)
        index = torch.from_numpy(call.rows)
        fresh = self.status[index] == _UNFINISHED
        if not bool(fresh.all()):
            index, x, status = index[fresh], x[fresh.to(x.device)], status[fresh]
        self._settle(index, x, status)
        if self.on_rows is not None:
            self.on_rows(index, x, status)

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
        for row in self._attempts.keys() & set(index.tolist()):
            self.tracebacks.pop(row, None)

    def _fail(self, call: Call, reply: Reply) -> None:
        if call.is_probe:
            if not self._num_probing and not self._has_succeeded:
                self._give_up(reply)
            return
        is_row = len(call) == 1 and call.draws != "blocks"
        is_block = len(call) <= BLOCK and call.draws == "blocks"
        if reply.fault == "worker died" and not call.is_second:
            again = call.part(slice(None), is_second=True)
            if (is_row or is_block) and not self._knows_guilty:
                self._suspects.append(again)
                return
            if is_block:  # perhaps an accident, after which x must be as without it
                self._urgent.appendleft(again)
                return
        if is_row:
            self._lose(call, reply)
            return
        if call.draws == "seeds":
            num_parts = 2 if reply.fault == "raised" else 16
            size = -(-len(call) // num_parts)
            parts = [call.part(slice(i, i + size)) for i in range(0, len(call), size)]
        elif not is_block:
            parts = [call.part(rows) for rows in call.blocks()]
        else:
            parts = [
                call.part(slice(i, i + 1), draws="alone", is_second=False)
                for i in range(len(call))
            ]
        self._urgent.extendleft(reversed(parts))

    def _lose(self, call: Call, reply: Reply) -> None:
        row = int(call.rows[0])
        if self.status[row] != _UNFINISHED:
            return
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
        if self._num_probing is None and len(self.tracebacks) >= self.NUM_PROBES:
            spread = np.linspace(0, len(self.status) - 1, self.NUM_PROBES)
            rows = np.unique(spread.round().astype(np.int64))
            draws = "seeds" if self.has_seeds else "alone"
            self._num_probing = len(rows)
            probes = [self._call(row[None], draws, is_probe=True) for row in rows]
            self._urgent.extendleft(probes)

    def _give_up(self, reply: Reply) -> None:
        first = next(iter(self.tracebacks.values()))
        raise SimulationError(
            "expected a simulator that can simulate; got a fault in each of the "
            f"{len(self.tracebacks)} rows tried, so no row is to blame; mend the "
            "simulator, or wrap a function of one row, SimulatorModel(fn, "
            f"batched=False). The first of them:\n{first}"
        ) from reply.error


def _last_line(reply: Reply) -> str:
    return reply.traceback.strip().splitlines()[-1]
