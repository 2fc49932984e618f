"""Run a simulator over rows so that x depends on nothing but its seed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import closing
from functools import partial
from typing import Any

import torch
from torch import Tensor
from tqdm.auto import tqdm

from sbi_active.arrays import own_tensor
from sbi_active.messages import warn
from sbi_active.renamed import takes_loose
from sbi_active.seeding import derive_seed
from sbi_active.simulation.outcomes import (
    MissingRowsWarning,
    SimulationInterrupted,
    Simulations,
)
from sbi_active.simulation.simulator import require_noise, require_rows
from sbi_active.simulation.workers.pools import InProcess, Pool, pool_of
from sbi_active.simulation.workers.schedule import Schedule
from sbi_active.simulation.workers.settings import Workers
from sbi_active.simulation.workers.store import Recorder, RowStore, find_store, spend


@takes_loose(workers=Workers)
def simulate(
    simulator: Callable[..., Any],
    theta: Tensor,
    action: Tensor,
    *,
    seed: int,
    workers: Workers | int | None = None,
    batch_size: int | None = None,
    show_progress: bool = False,
    store: RowStore | None = None,
    check_noise: bool = False,
) -> Simulations:
    r"""Draw :math:`x_i \sim p(x | \theta_i, \xi_i)`.

    x is a function of the seed, theta and the action, whatever the number of workers
    and the size of a batch. A simulator that takes ``seeds`` gets one a row. Any other
    runs in fixed blocks of 256 rows under forked generators of torch and NumPy, which
    are restored; where such a block fails, its rows run singly, each under generators
    of its own, so that their x differs from what it would have been, though it is
    still a function of the seed and the row.

    A row whose call raises, ends its process or exceeds the time limit is missing, with
    the text of its traceback, and costs no other row. A row of NaN or infinite numbers
    alone is invalid. A simulator that fails on every row, or returns other rows than it
    was given, raises: that is no fault of a row.

    More than one worker means processes of this machine, one thread each, which receive
    the simulator once. They wait a minute for the next call with the same simulator, so
    that a module of it that is edited meanwhile is not read again. A cluster of Dask is
    one line of joblib's configuration::

        client = distributed.Client("scheduler:8786")
        with joblib.parallel_config(backend="dask"):
            simulate(simulator, theta, action, seed=0, workers=64)

    A lost Dask worker loses no rows.

    Args:
        simulator: ``simulator(theta, action)``, see
            :class:`.Simulator`.
        theta: Parameters, shape (n, theta_dim).
        action: Actions, shape (n, action_dim).
        seed: Seed of the whole set.
        workers: Workers that run the rows and what one may cost, or the number of calls
            at a time; None is this process.
        batch_size: Rows a call; None gives as many as take about a second, and an
            interrupt loses no more. A simulator in this process is given all at once
            where that takes no longer, and one that takes no seeds whole blocks.
        show_progress: Show a progress bar.
        store: Keeps finished rows, every half second, and gives those that it has;
            None takes that of the campaign whose directory this is called for, if any.
        check_noise: Whether to simulate the first rows under a second seed and raise if
            nothing differs.

    Returns:
        The simulations, x in float32.

    Raises:
        ValueError: If the shapes or options do not fit, or the simulator is
            deterministic and ``check_noise`` is set.
        SimulationError: If no row could be simulated.
        SimulationInterrupted: On a keyboard interrupt; it carries what is finished.

    Example:
        >>> rows = simulate(
        ...     lambda theta, action: theta * action + torch.randn_like(theta),
        ...     torch.ones(3, 1), torch.ones(3, 1), seed=0,
        ... )
        >>> rows.x.shape
        torch.Size([3, 1])
    """
    theta = own_tensor(theta, torch.float32, name="theta")
    action = own_tensor(action, torch.float32, name="action")
    require_rows(theta, action)
    if not len(theta):
        raise ValueError("expected at least one row; got none; pass theta of n >= 1")
    workers = Workers.of(workers)
    if batch_size is not None and batch_size < 1:
        raise ValueError(
            f"expected batch_size >= 1; got {batch_size}; use None to have it chosen"
        )
    store = find_store(simulator) if store is None else store
    pool = pool_of(simulator, workers)
    is_here = isinstance(pool, InProcess)
    if not is_here:
        theta, action = theta.detach().cpu(), action.detach().cpu()
    schedule = partial(
        Schedule,
        simulator,
        workers=workers,
        batch_size=batch_size,
        starts_over=is_here and store is None and not show_progress,
    )
    with closing(pool):
        whole = schedule(theta, action, seed)
        _run(whole, pool, store, show_progress)
        if check_noise:
            other = schedule(theta[:16], action[:16], derive_seed(seed, "again"))
            _run(other, pool, None, False)
            require_noise(whole.rows().x[:16], other.rows().x)
    rows = whole.rows()
    if num_lost := len(whole.lost):
        faults = Counter(reply.fault for reply in whole.lost.values())
        counts = ", ".join(f"{k} {fault}" for fault, k in faults.items())
        row, text = next(iter(rows.tracebacks.items()))
        warn(
            f"SA301 {num_lost} of {len(theta)} rows are missing: {counts}; "
            f"the first is row {row}: {text.strip().splitlines()[-1]}. All tracebacks "
            "are in Simulations.tracebacks",
            MissingRowsWarning,
        )
    return rows


def _run(
    schedule: Schedule, pool: Pool, store: RowStore | None, show_progress: bool
) -> None:
    recorder, num_rows = Recorder(store, schedule), len(schedule.theta)
    stored = int((schedule.status >= 0).sum())
    spend(num_rows - stored)
    bar = tqdm(total=num_rows, initial=stored, unit="row", disable=not show_progress)
    try:
        with bar:
            for num_finished in schedule.run(pool):
                bar.update(num_finished)
                recorder.save()
    except KeyboardInterrupt:
        if schedule.x is None:
            raise
        raise SimulationInterrupted(schedule.rows()) from None
    finally:
        recorder.save(at_once=True)
