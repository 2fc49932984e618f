"""Workers that run simulations, and the cost of a row."""

from __future__ import annotations

from dataclasses import dataclass

from sbi_active.expected import require, require_least, suggests


@suggests
@dataclass(frozen=True)
class Workers:
    """Workers that run simulations, and the cost of a row; x does not depend on them.

    Attributes:
        num_workers: Number of calls at a time; -1 means one a core. One worker without
            a time limit is this process.
        time_limit: Seconds a row, loading the simulator not counted; a batch may take
            as much as its rows. None waits for ever. With it, or with more than one
            worker, a simulator that ends its process costs a row.
        num_retries: Number of times that a missing row is tried again, with the same
            seed.

    Raises:
        ValueError: If a number is out of its range.
    """

    num_workers: int = 1
    time_limit: float | None = None
    num_retries: int = 0

    def __post_init__(self) -> None:
        require(
            self.num_workers >= 1 or self.num_workers == -1,
            "num_workers >= 1, or -1 for one a core",
            self.num_workers,
            "use 1 to simulate in this process",
        )
        require(
            self.time_limit is None or self.time_limit > 0,
            "time_limit > 0 s a row",
            self.time_limit,
            "use None to wait for ever",
        )
        require_least(self, "use 0 to try once", num_retries=0)

    @classmethod
    def of(cls, workers: Workers | int | None) -> Workers:
        """Return workers as they are, or so many of them; None is this process."""
        if isinstance(workers, cls):
            return workers
        return cls(1 if workers is None else workers)  # pyright: ignore


#: Without other processes, whose death would cost a row.
IN_PROCESS = Workers()
