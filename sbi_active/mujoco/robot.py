"""A robot from its MJCF: simulator, prior, actions and trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from sbi.utils import BoxUniform
from torch import Tensor

from sbi_active.actions import ActionSpace, MixedActions
from sbi_active.actions.signals import SignalActions
from sbi_active.arrays import Array
from sbi_active.criticism.data.trials import Trials
from sbi_active.expected import require, suggests
from sbi_active.mujoco.models.machine import Machine
from sbi_active.mujoco.models.names import (
    element_id,
    meaning,
    names_of,
    places_of,
    require_name,
)
from sbi_active.mujoco.models.parameters import Bounded, bounded
from sbi_active.mujoco.models.running import initial
from sbi_active.mujoco.models.spec import Source, mujoco
from sbi_active.mujoco.recordings import require_in_range, require_seconds, trials_of
from sbi_active.mujoco.sensors import added_sensors, channels_of
from sbi_active.mujoco.simulator import MODEL, MujocoFunction
from sbi_active.simulation import SimulatorModel
from sbi_active.simulation.noise.base import NoiseModel


def named_box(parameters: Sequence[Bounded]) -> BoxUniform:
    """Return a uniform prior whose sides have ``names`` and ``units``.

    It is sbi's own class, which a campaign's folder can store.

    Args:
        parameters: Parameters with bounds, names and units.
    """
    box = BoxUniform(
        torch.tensor([p.low for p in parameters]),
        torch.tensor([p.high for p in parameters]),
    )
    vars(box)["names"] = tuple(p.name for p in parameters)
    vars(box)["units"] = tuple(p.unit for p in parameters)
    return box


class Robot(NamedTuple):
    """The parts of a robot that a campaign or the closed loop needs.

    Attributes:
        simulator: Simulator that runs MuJoCo; ``simulator.fn`` is a
            :class:`.MujocoFunction`.
        prior: Prior, uniform within the bounds of the parameters, with ``names`` and
            ``units``.
        actions: Actions that the robot may take; None if only recordings say that.
        trials: The recordings; None if there are none.
    """

    simulator: SimulatorModel
    prior: BoxUniform
    actions: ActionSpace | None = None
    trials: Trials | None = None


@suggests
def from_mjcf(
    spec_or_path: Any,
    parameters: Mapping[str, Any],
    *,
    inputs: Sequence[str] | SignalActions | None = None,
    sensors: Sequence[str] | None = None,
    actions: ActionSpace | None = None,
    times: Any = None,
    noise: NoiseModel | float | Tensor | Mapping[str, float] | None = None,
    start: Mapping[str, float] | str | None = None,
    recordings: Any = None,
) -> Robot:
    r"""Return a robot from its MJCF, ready for ``Campaign`` and ``close_loop``.

    Args:
        spec_or_path: An ``MjSpec``, the path of an MJCF, or its text; or a list of such
            that share all parameters, as with and without a payload, of which the entry
            "model" of an action is the number.
        parameters: Unknown parameters by name: ``{"hinge.damping": (low, high)}`` for a
            quantity of :mod:`.quantities`; ``{"friction": (low, high,
            "hinge.frictionloss")}`` under a name of one's own; ``{"length": (low, high,
            edit)}`` with ``edit(spec, value)`` for what only the spec can say. The
            prior is uniform within these bounds.
        inputs: Actuators that recordings drive, None for all; or a space of signals
            named by actuators. These signals are then the actions.
        sensors: Sensors of the MJCF that are read, None for all; also joints, as in
            "hinge" or "hinge velocity", for which it has no sensor. None reads all
            joints of an MJCF without sensors.
        actions: Actions that are chosen in each trial, beside a signal too: its names
            are joints (start positions), joints with ``" velocity"`` behind, actuators
            (a control that is held), or "model". A name that a joint and an actuator
            share is the actuator's; the joint's start is then "hinge position".
        times: Times of the readings, s from the start of a trial, shape (k,); None
            takes those of the inputs, of the recordings, or they come with the trials.
        noise: Noise of the sensors, as ``SimulatorModel`` takes it, or standard
            deviations by sensor; None takes ``noise`` of the sensors in the MJCF, where
            it is given.
        start: Start state of trials whose action or recording does not give it:
            positions, velocities, controls that are held ("motor control") and poses of
            mocap bodies ("target mocap[0]") by name, or the name of a keyframe, which
            gives all of these. None is the model's.
        recordings: Logs, one a trial, as in :func:`.trials_of`, or a folder of them.

    Raises:
        ValueError: If the MJCF does not compile, a name does not exist (the nearest are
            told), a control is outside its range, or a log does not fit.
        ImportError: If MuJoCo is not installed.

    Example:
        >>> robot = from_mjcf(
        ...     '''<mujoco><worldbody><body name="bob"><joint name="hinge" axis="0 1 0"
        ...     /><geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1"/>
        ...     </body></worldbody></mujoco>''',
        ...     {"hinge.damping": (0.0, 0.1)}, sensors=["hinge"], noise=0.01,
        ...     times=[0.1, 0.2], start={"hinge": 1.0},
        ... )
        >>> robot.simulator.parameter_names, robot.prior.units
        (['hinge.damping'], ('N m s/rad',))
        >>> robot.simulator.mean(torch.zeros(1, 1), torch.zeros(1, 1)).shape
        torch.Size([1, 2])
    """
    every = spec_or_path if isinstance(spec_or_path, list | tuple) else [spec_or_path]
    sources = [added_sensors(Source(given), sensors) for given in every]
    declared = bounded(sources[0].compile(), parameters)
    machines = [Machine(source, declared) for source in sources]
    require_usable(machines)
    machine = machines[0]
    channels = channels_of(machine.model, sensors)
    space, driven = _inputs(machine.model, inputs)
    played = driven if space is not None else []
    actions, roles = _actions(machine.model, actions, space, played)
    trials = None
    if recordings is not None:
        trials = trials_of(machine.model, recordings, channels, inputs=driven)
        if times is None and trials.sample_times is not None:
            times = trials.sample_times if trials.sample_times.ndim == 1 else None
    if times is None and space is not None:
        times = space.input_times
    grid = None if times is None else np.asarray(times, dtype=np.float64)
    if grid is not None:
        require_seconds(grid, float(machine.model.opt.timestep), "times=")
    begin = _start(machine.model, start)
    function = MujocoFunction(machines, channels, roles=roles, start=begin)
    inputs = None if space is None else actions  # pyright: ignore[reportAssignmentType]
    errors = _noise(machine.model, channels, noise)
    return robot_of(function, errors, inputs, actions, trials, grid)


def robot_of(
    function: MujocoFunction,
    noise: Any,
    inputs: Any,
    actions: ActionSpace | None,
    trials: Trials | None,
    times: Array | None,
) -> Robot:
    """Return the robot of a function, a prior of its parameters beside it.

    Args:
        function: Function that runs MuJoCo.
        noise: Noise of the sensors, as ``SimulatorModel`` takes it.
        inputs: Space of signals that actions play; None for none.
        actions: Actions that the robot may take.
        trials: Recorded trials.
        times: Times of the readings where trials do not say, shape (k,).
    """
    parameters = function.machines[0].parameters
    simulator = SimulatorModel(
        function,
        noise=noise,
        parameter_names=[p.name for p in parameters],
        channel_names=[channel.label for channel in function.channels],
        sample_times=None if times is None else torch.from_numpy(times),
        inputs=inputs,
    )
    return Robot(simulator, named_box(parameters), actions, trials)


def require_usable(machines: Sequence[Machine]) -> None:
    """Raise if models differ in what trials say of them by name."""
    for kind in ("joint", "actuator", "sensor"):
        first = names_of(machines[0].model, kind)
        for k, machine in enumerate(machines):
            own = names_of(machine.model, kind)
            got = f"{', '.join(own)} in model {k} beside {', '.join(first)}"
            require(
                own == first, f"models with the same {kind}s", got, "name them alike"
            )


def from_spec(spec_or_path: Any) -> Robot:
    """Return a model without parameters as a robot, read by all its joints."""
    machine = Machine(added_sensors(Source(spec_or_path), None), ())
    function = MujocoFunction([machine], channels_of(machine.model, None))
    simulator = SimulatorModel(function)
    return Robot(simulator, prior=None)  # pyright: ignore[reportArgumentType]


def _inputs(model: Any, inputs: Any) -> tuple[SignalActions | None, list[str]]:
    """Return the space of signals, if any, and the names of driven actuators."""
    known = names_of(model, "actuator")
    if not isinstance(inputs, SignalActions):
        driven = known if inputs is None else [*inputs]
        for name in driven:
            require_name(name, known, "actuator")
        return None, driven
    played = inputs.inputs(inputs.sample((64,), seed=0))
    for name, series in played.items():
        require_name(name, known, "actuator")
        require_in_range(model, name, series.numpy(), "a signal")
    return inputs, [*played]


def _actions(
    model: Any,
    actions: ActionSpace | None,
    space: SignalActions | None,
    played: Sequence[str],
) -> tuple[ActionSpace | None, tuple[str, ...]]:
    """Return the actions, and what each entry sets in the model; "" for a signal's."""
    if actions is None:
        return space, ()
    controls = {f"{name} control": name for name in names_of(model, "actuator")}
    joints = (f"{n} position" for n in names_of(model, "joint"))
    free = [name for name in controls.values() if name not in played]
    known = [*places_of(model), *free, *joints, MODEL]
    for k, name in enumerate(actions.names):
        require_name(name, known, "joint, a joint with ' velocity', or an actuator")
        control = controls.get(meaning(name, model))
        require(
            control not in played,
            f"{name!r} to be set once",
            "an action and a signal of this actuator",
            f"call the start of a joint '{name} position'",
        )
        if control is not None:
            drawn = actions.sample((64,), seed=0)[:, k]
            require_in_range(model, control, drawn.numpy(), "an action")
    if space is None:
        return actions, (*actions.names,)
    return MixedActions(space, actions), (*[""] * space.action_dim, *actions.names)


def _start(
    model: Any, start: Mapping[str, float] | str | None
) -> dict[str, float] | None:
    if start is None:
        return None
    places = places_of(model)
    if isinstance(start, str):
        key = element_id(model, "key", start)
        state = initial(model, mujoco.MjData(model), key)
        return {name: float(state[place]) for name, place in places.items()}
    for name in start:
        require_name(name, places, "joint, or one with ' velocity',")
    return {name: float(value) for name, value in start.items()}


def _noise(model: Any, channels: Sequence[Any], noise: Any) -> Any:
    if isinstance(noise, Mapping):
        known = [c.name for c in channels]
        for name in noise:
            require_name(name, known, "sensor")
        lost = ", ".join(name for name in known if name not in noise)
        require(not lost, "the noise of every sensor", f"none of {lost}", "add it")
        sds = [float(noise[name]) for name in known]
        return sds[0] if len(sds) == 1 else torch.tensor(sds)
    if noise is not None:
        return noise
    each = np.repeat(model.sensor_noise, model.sensor_dim)
    sds = [float(each[channel.place]) for channel in channels]
    if min(sds) <= 0:
        return None
    return sds[0] if len(sds) == 1 else torch.tensor(sds)
