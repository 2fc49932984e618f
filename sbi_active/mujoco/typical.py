"""A few typical rows of a robot, and parameters that change nothing in them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.actions import ActionSpace
from sbi_active.criticism.data.trials import Trials
from sbi_active.messages import warn
from sbi_active.mujoco.models.names import scalar_joints
from sbi_active.mujoco.simulator import MujocoFunction
from sbi_active.simulation import SimulatorModel

#: Rows that are looked at.
NUM_ROWS = 4
#: Where nothing says how the robot moves: rad or m from the start, s.
SPREAD, SECONDS = 0.5, 1.0


def typical_call(
    simulator: SimulatorModel, trials: Trials | None, actions: Any
) -> dict[str, Any]:
    """Return arguments of a call of a few typical rows, at middle parameters.

    Args:
        simulator: Simulator of a :class:`.MujocoFunction`.
        trials: Trials that say how the robot moves; None takes signals or actions.
        actions: Permitted actions, where there are no trials.
    """
    function = simulator.fn
    assert isinstance(function, MujocoFunction)
    machine = function.machines[0]
    middle = torch.tensor(
        [0.5 * (p.low + p.high) for p in machine.parameters], dtype=torch.float64
    )
    call: dict[str, Any] = {}
    if trials is not None:
        some = torch.linspace(0, len(trials) - 1, min(NUM_ROWS, len(trials))).long()
        picked = trials.select(some.unique())
        call["action"] = picked.action.double()
        if picked.inputs is not None:
            call |= {"inputs": picked.inputs, "input_times": picked.input_times}
        if picked.start is not None:
            call["start"] = picked.start
        if picked.sample_times is not None:
            times = picked.sample_times.expand(len(picked), -1)
            last = times.nan_to_num(-torch.inf).amax(1, keepdim=True)
            call["times"] = times.where(times.isfinite(), last).double()
    elif simulator.inputs is not None or actions is not None:
        space = simulator.inputs or actions
        call["action"] = space.sample((NUM_ROWS,), seed=0).double()
        if simulator.inputs is not None:
            call["inputs"] = simulator.inputs.inputs(call["action"])
            call["input_times"] = simulator.inputs.input_times
    else:
        call |= _released(machine.model)
    num = len(call["action"])
    if "times" not in call and function.times is None:
        grid = torch.linspace(0, SECONDS, 51, dtype=torch.float64)
        call["times"] = grid.expand(num, -1)
    return {"theta": middle.expand(num, -1), **call}


def _released(model: Any) -> dict[str, Any]:
    """Return start states around that of the model."""
    rng = np.random.default_rng(0)
    start = {}
    for name, joint in scalar_joints(model).items():
        rest = model.qpos0[model.jnt_qposadr[joint]]
        start[name] = torch.from_numpy(rest + SPREAD * rng.uniform(-1, 1, NUM_ROWS))
    return {"action": torch.zeros(NUM_ROWS, 1, dtype=torch.float64), "start": start}


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
    if trials is None and (actions is None or simulator.sample_times is None):
        return
    call = typical_call(simulator, trials, actions)
    middle = call.pop("theta")

    def x(k: int, value: Tensor) -> Tensor:
        theta = middle.clone()
        theta[:, k] = value
        return simulator.fn(theta, **call)

    idle = []
    ends = zip(prior.base_dist.low, prior.base_dist.high, strict=True)
    names = simulator.parameter_names or ()
    for k, (name, (low, high)) in enumerate(zip(names, ends, strict=True)):
        first, last = x(k, low), x(k, high)
        if bool(((first == last) | (first.isnan() & last.isnan())).all()):
            idle.append(name)
    if idle:
        where = "the recorded trials" if trials is not None else "permitted actions"
        warn(
            f"SA303 {', '.join(idle)} change nothing that is read in {len(middle)} of "
            f"{where}: no such trial tells of them; leave them out, or read another "
            "sensor",
            stacklevel=5,
        )
