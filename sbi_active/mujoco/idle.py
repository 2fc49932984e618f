"""Parameters that change nothing, found before anything is spent."""

from __future__ import annotations

from typing import Any

import torch

from sbi_active.actions import ActionSpace
from sbi_active.criticism.data.trials import Trials
from sbi_active.messages import warn
from sbi_active.simulation import SimulatorModel

#: Trials or actions that are tried.
NUM_TRIED = 4


def warn_of_idle(
    simulator: SimulatorModel,
    prior: Any,
    actions: ActionSpace | None,
    trials: Trials | None,
) -> None:
    """Warn of parameters that change nothing from one bound to the other.

    They are tried one by one at the middle of all others, in a few recorded trials, or
    actions if there are none. Nothing is tried if neither says how a trial is run.

    Args:
        simulator: Simulator of a :class:`.MujocoFunction`.
        prior: Prior, a box.
        actions: Permitted actions.
        trials: Recorded trials.
    """
    run: dict[str, Any] = {}
    if trials is not None:
        some = trials[: min(NUM_TRIED, len(trials))]
        action = some.action
        for name in ("inputs", "input_times", "start"):
            if getattr(some, name) is not None:
                run[name] = getattr(some, name)
        if some.sample_times is not None:
            times = some.sample_times.expand(len(some), -1)
            last = times.nan_to_num(-torch.inf).amax(1, keepdim=True)
            run["times"] = times.where(times.isfinite(), last)
    elif actions is not None and simulator.sample_times is not None:
        action = actions.sample((NUM_TRIED,), seed=0)
    else:
        return
    low, high = prior.base_dist.low.double(), prior.base_dist.high.double()
    bare = simulator.without_noise()
    action = action.double()

    def x(theta: torch.Tensor) -> torch.Tensor:
        return bare(theta.expand(len(action), -1), action, **run)

    names = simulator.parameter_names or ()
    idle = []
    for k, name in enumerate(names):
        ends = [0.5 * (low + high) for _ in range(2)]
        ends[0][k], ends[1][k] = low[k], high[k]
        first, last = x(ends[0]), x(ends[1])
        if bool(((first == last) | (first.isnan() & last.isnan())).all()):
            idle.append(name)
    if idle:
        where = "the recorded trials" if trials is not None else "permitted actions"
        warn(
            f"SA303 {', '.join(idle)} change nothing that is read in {len(action)} of "
            f"{where}: no such trial tells of them; leave them out, or read another "
            "sensor",
            stacklevel=4,
        )
