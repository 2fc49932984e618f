"""A few typical rows of a robot: their sizes, and what changes nothing in them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.actions import ActionSpace
from sbi_active.arrays import Array
from sbi_active.criticism.data.trials import Trials
from sbi_active.messages import warn
from sbi_active.mujoco.models.names import scalar_joints
from sbi_active.mujoco.models.running import Run
from sbi_active.mujoco.models.spec import mujoco
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
            "sensor"
        )


#: States that are looked at in each row.
NUM_STATES = 200
#: Share of the states that are usual, and times their root mean square that others
#: count for at most.
USUAL, JOLT = 0.95, 10.0


@dataclass(frozen=True)
class Nominal:
    """Sizes along nominal trajectories, at the middle of the parameters' bounds.

    Attributes:
        model: Model at these parameters.
        position: Half the range that 90 % of the time is spent in, (nv,), rad or m.
        lowest: Lower end of all of it, (nv,), as a hinge or slide is read.
        highest: Upper end.
        velocity: Root mean square of the velocity, (nv,).
        force: Root of the mean square of gravity and inertia, of actuators and of
            passive forces, (nv,), N m or N.
        inertia: Inertia of each degree of freedom with all others held, (nv,).
        actuator_force: Root mean square of the force, one an actuator.
        actuator_velocity: Root mean square of the velocity of its length, one an
            actuator.
        reading: Standard deviation of each channel, (c,).
        times: Times of the readings of one row, (k,).
        has_contacts: Whether anything touched.
    """

    model: Any
    position: Array
    lowest: Array
    highest: Array
    velocity: Array
    force: Array
    inertia: Array
    actuator_force: Array
    actuator_velocity: Array
    reading: Array
    times: Array
    has_contacts: bool


def nominal(
    simulator: SimulatorModel, trials: Trials | None, actions: Any
) -> tuple[Nominal, dict[str, Any]]:
    """Return sizes, and rows on which effects can be tried.

    Args:
        simulator: Simulator of a :class:`.MujocoFunction`.
        trials: Trials that say how the robot moves; None takes signals or actions.
        actions: Permitted actions, where there are no trials.

    Returns:
        The sizes; and theta, action and keyword arguments of a call.
    """
    function = simulator.fn
    assert isinstance(function, MujocoFunction)
    call = typical_call(simulator, trials, actions)
    seen: list[dict[str, Array]] = []
    x = function(**call, watch=lambda run: seen.append(_watched(run)))
    together = {k: np.concatenate([s[k] for s in seen]) for k in seen[0]}
    model = function.machines[0].model
    # Positions are counted from the model's own, as a hinge or slide reads there.
    zeros = np.zeros(model.nv)
    joints = [*scalar_joints(model).values()]
    zeros[model.jnt_dofadr[joints]] = model.qpos0[model.jnt_qposadr[joints]]
    low, high = np.percentile(together["q"], [5, 95], axis=0)
    parts = [_rms(together[k]) ** 2 for k in ("bias", "actuator", "passive")]
    readings = x.double().reshape(len(x), x.shape[1], -1).numpy()
    times = call.get("times")
    own = function.times if times is None else times[0].numpy()
    assert own is not None
    return (
        Nominal(
            model,
            position=_positive(0.5 * (high - low), SPREAD),
            lowest=together["q"].min(0) + zeros,
            highest=together["q"].max(0) + zeros,
            velocity=_positive(_rms(together["v"]), 1.0),
            force=_positive(np.sqrt(sum(parts)), 1.0),
            inertia=together["inertia"].mean(0),
            actuator_force=_positive(_rms(together["force"]), 1.0),
            actuator_velocity=_positive(_rms(together["speed"]), 1.0),
            reading=_positive(np.nanstd(readings, (0, 1)), 1.0),
            times=own[np.isfinite(own)],
            has_contacts=bool(together["contacts"].any()),
        ),
        call,
    )


def _watched(run: Run) -> dict[str, Array]:
    """Return states and forces along rows."""
    found: dict[str, list[Array]] = {}
    every = max(1, run.controls.shape[1] // NUM_STATES)
    for i, own in enumerate(run.models):
        data = mujoco.MjData(own)
        run.begin(i, data)
        inertia = np.array(own.dof_M0)
        for k, control in enumerate(run.controls[i]):
            data.ctrl[:] = control[: own.nu]
            mujoco.mj_step(own, data)
            if k % every or data.warning.number.any():
                continue
            state = {
                "q": _scalars(own, data),
                "v": data.qvel,
                "bias": data.qfrc_bias,
                "actuator": data.qfrc_actuator,
                "passive": data.qfrc_passive,
                "force": data.actuator_force,
                "speed": data.actuator_velocity,
                "inertia": inertia,
                "contacts": np.array([data.ncon]),
            }
            for name, value in state.items():
                found.setdefault(name, []).append(np.array(value, dtype=float))
    return {name: np.stack(each) for name, each in found.items()}


def _scalars(model: Any, data: Any) -> Array:
    """Return the position of every degree of freedom, from that of the model."""
    away = np.zeros(model.nv)
    mujoco.mj_differentiatePos(model, away, 1.0, model.qpos0, data.qpos)
    return away


def _rms(value: Array) -> Array:
    """Return root mean squares over states, which no jolt decides, shape (k,).

    A robot that starts beyond a joint's limit is thrown back by hundreds of times what
    moves it afterwards, and priors as wide would have its fits begin out there.
    """
    size = np.abs(value)
    usual = size <= np.quantile(size, USUAL, axis=0)
    count = np.maximum(usual.sum(0), 1)  # none where a state diverged
    rms = np.sqrt(np.where(usual, size**2, 0.0).sum(0) / count)
    most = np.where(rms > 0, JOLT * rms, np.inf)
    return np.sqrt((np.minimum(size, most) ** 2).mean(0))


def _positive(value: Array, otherwise: float) -> Array:
    """Return sizes, those of what does not move as the others' or a default."""
    value = np.nan_to_num(np.asarray(value, dtype=float))
    moving = value > 1e-9 * max(value.max(initial=0.0), 1e-12)
    typical = float(np.median(value[moving])) if moving.any() else otherwise
    return np.where(moving, value, typical)
