"""Workers that run simulations, and the cost of a row."""

from __future__ import annotations

from numbers import Real
from typing import Any

from attrs import field, frozen

from sbi_active.expected import at_least, positive, require, suggests


def _is_number_of_workers(settings: Any, attribute: Any, value: Any) -> None:
    is_number = isinstance(value, Real)
    require(
        is_number and (float(value) >= 1 or value == -1),
        "num_workers >= 1, or -1 for one a core",
        repr(value),
        "use 1 to simulate in this process",
    )


@suggests
@frozen(slots=False)
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

    num_workers: int = field(default=1, validator=_is_number_of_workers)
    time_limit: float | None = field(
        default=None, validator=positive("use None to wait for ever")
    )
    num_retries: int = field(default=0, validator=at_least(0, "use 0 to try once"))

    @classmethod
    def of(cls, workers: Workers | int | None) -> Workers:
        """Return workers as they are, or so many of them; None is this process."""
        if isinstance(workers, cls):
            return workers
        return cls(1 if workers is None else workers)  # pyright: ignore


#: Without other processes, whose death would cost a row.
IN_PROCESS = Workers()
