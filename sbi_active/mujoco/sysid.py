r"""Data and parameters of ``mujoco.sysid`` as simulator, prior, actions and trials.

The simulation is that of ``mujoco.sysid``: controls are lines between their samples,
taken at the model's steps and held over each; a sensor's reading is stamped with the
end of the step at whose begin it was taken, and a state with its own time. Signals are
compared at the measured times that its window keeps. A transform's delays, gains and
biases act on the prediction, those of the measured signals the other way round, so that
outcomes are in the units in which they were measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor

from sbi_active.actions import ActionSpace, DiscreteActions
from sbi_active.actions.signals import SignalActions
from sbi_active.actions.waveforms import Recorded
from sbi_active.arrays import Array
from sbi_active.criticism.data.trials import Trials
from sbi_active.expected import require, suggests
from sbi_active.mujoco.models.machine import Machine
from sbi_active.mujoco.models.names import names_of, scalar_joints, start_places
from sbi_active.mujoco.models.parameters import Bounded
from sbi_active.mujoco.models.spec import Source
from sbi_active.mujoco.recordings import require_in_range
from sbi_active.mujoco.robot import Robot, require_usable, robot_of
from sbi_active.mujoco.sensors import AddedSensor, channels_of
from sbi_active.mujoco.simulator import MODEL, RECORDING, Channel, MujocoFunction
from sbi_active.mujoco.transforms import Signal, SignalReadout
from sbi_active.simulation import AutocorrelatedNoise
from sbi_active.simulation.noise.base import NoiseModel

#: Unknown errors, from this share of a signal's deviation up to all of it, lasting from
#: this share of a sample's distance up to this share of a trial.
SHARE, SHORT, LONG = 1e-4, 0.1, 0.5
#: Endings of signals that are states, and what they read, by kind.
STATES = {"MjStateQPos": ("_qpos", "position"), "MjStateQVel": ("_qvel", "velocity")}


@suggests
def from_sysid(
    model_sequences: Any,
    params: Any,
    *,
    transform: Any = None,
    actions: ActionSpace | None = None,
    noise: NoiseModel | float | Tensor | None = None,
) -> Robot:
    r"""Return a robot from the data and parameters of ``mujoco.sysid``.

    Several ``ModelSequences``, as of a robot with and without a payload, share theta.
    Parameters keep the order of ``params.as_vector()``, and frozen ones their value.

    Args:
        model_sequences: One ``ModelSequences``, or several.
        params: A ``ParameterDict``; the prior is uniform within its ``get_bounds()``.
        transform: A ``SignalTransform``. Its weights and normalization are not needed
            if noise is declared.
        actions: Actions that the robot may take; None takes the recorded sequences, of
            which the action is the number. Entries are those of
            :class:`.MujocoFunction`; "model" is the number of a ``ModelSequences``.
        noise: Noise of the signals, one or one a signal; None takes autocorrelated
            errors of unknown size, one a signal, and unknown correlation time.

    Raises:
        ValueError: If signals differ between sequences, a signal is not one of the
            model, a control or a measured signal is not finite, or a control is outside
            its range.
    """
    is_several = isinstance(model_sequences, Sequence)
    groups = [*model_sequences] if is_several else [model_sequences]
    edit, declared, signals = _Edit(params), _free(params), _signals(groups)
    machines, channels = [], ()
    for group in groups:
        source, channels = _readable(Source(group.spec), signals)
        machines.append(Machine(source, declared, edit=edit))
    require_usable(machines)
    read = [s for s in signals for _ in range(s.width)]
    enabled = None if transform is None else transform._enabled_sensors
    kept = [k for k, s in enumerate(read) if enabled is None or s.name in enabled]
    channels, read = [channels[k] for k in kept], [read[k] for k in kept]
    step = float(machines[0].model.opt.timestep)
    stamp = step * np.array([s.kind == "MjSensor" for s in read])
    readout = SignalReadout.of(transform, params, [s.name for s in read], stamp)
    trials = _trials(groups, machines, signals, kept, readout.window, channels)
    space = _recorded(trials) if actions is None else actions
    times, start = trials.sample_times, trials.start
    assert times is not None
    assert isinstance(start, dict)
    function = MujocoFunction(
        machines,
        channels,
        roles=(RECORDING,) if actions is None else tuple(actions.names),
        readout=readout,
        recorded={name: value.numpy() for name, value in start.items()},
    )
    noise = _noise(trials) if noise is None else noise
    inputs = space if isinstance(space, SignalActions) else None
    grid = times.numpy() if times.ndim == 1 else None
    return robot_of(function, noise, inputs, space, trials, grid)


def _free(params: Any) -> tuple[Bounded, ...]:
    """Return names and bounds of the parameters of a ``ParameterDict`` not frozen."""
    names = params.get_non_frozen_parameter_names()
    advice = "free the unknown ones"
    require(bool(names), "a parameter that is not frozen", "none", advice)
    each = zip(names, *params.get_bounds(), strict=True)
    return tuple(Bounded(name, float(low), float(high)) for name, low, high in each)


class _Edit:
    """Puts parameters into a spec by their modifiers.

    A ``Parameter`` that is pickled loses its modifier: what it has is kept apart.

    Args:
        params: A ``ParameterDict``.
    """

    def __init__(self, params: Any) -> None:
        self.free = [dict(vars(p)) for p in params.values() if not p.frozen]

    def __call__(self, spec: Any, theta: Array) -> None:
        from mujoco.sysid import Parameter  # pyright: ignore

        first = 0
        for each in self.free:
            parameter = Parameter.__new__(Parameter)
            vars(parameter).update(each)
            last = first + parameter.size
            parameter.update_from_vector(np.asarray(theta)[first:last])
            parameter.apply_modifier(spec)
            first = last


def _signals(groups: Sequence[Any]) -> list[Signal]:
    """Return the signals that all sequences have."""
    found: list[Signal] = []
    for group, series in ((g, series) for g in groups for series in g.sensordata):
        own = [
            Signal(name, kind.name, len(np.atleast_1d(places)))
            for name, (kind, places) in _mapping(series, group).items()
        ]
        found = found or own
        got = f"{[s.name for s in own]} in {group.name!r} beside "
        got += f"{[s.name for s in found]}"
        expected = "the same signals in all sequences"
        require(own == found, expected, got, "slice them by name")
    return found


def _mapping(series: Any, group: Any) -> Any:
    """Return kind and columns of each signal of a time series, by name."""
    if series.signal_mapping is not None:
        return series.signal_mapping
    return type(series).compute_all_sensor_mapping(group.gt_model)


def _readable(
    source: Source, signals: Sequence[Signal]
) -> tuple[Source, tuple[Channel, ...]]:
    """Return a source with a sensor of every signal, and the channels."""
    joints = scalar_joints(source.compile())
    edits, reads, names = [], [], []
    for signal in signals:
        kind, name = signal.kind, signal.name
        expected, got = "sensors, positions or velocities", f"{name!r} of type {kind}"
        advice = "leave it out, or give its sensor"
        require(kind in ("MjSensor", *STATES), expected, got, advice)
        reads.append(name)
        if kind in STATES:
            ending, what = STATES[kind]
            joint = name.removesuffix(ending)
            expected, advice = "the state of a hinge or slide", "pass sensors of others"
            require(joint in joints, expected, repr(name), advice)
            reads[-1] = f"state {name}"
            edits.append(AddedSensor(reads[-1], joint, what))
        wide = [f"{name}[{k}]" for k in range(signal.width)]
        names += [name] if signal.width == 1 else wide
    source = source.edited(*edits)
    pairs = zip(names, channels_of(source.compile(), reads), strict=True)
    return source, tuple(Channel(name, c.place) for name, c in pairs)


def _trials(
    groups: Sequence[Any],
    machines: Sequence[Machine],
    signals: Sequence[Signal],
    kept: Sequence[int],
    window: tuple[float, float],
    channels: Sequence[Channel],
) -> Trials:
    """Return recorded sequences as trials, of which the action is the number.

    Args:
        groups: ``ModelSequences``.
        machines: Models of these.
        signals: Signals that all sequences have.
        kept: Numbers of the columns that are read.
        window: Lowest and highest delay.
        channels: Channels of x.
    """
    names, x, times, grids = [], [], [], []
    starts: list[dict[str, float]] = []
    controls: list[dict[str, Array]] = []
    for k, (group, machine) in enumerate(zip(groups, machines, strict=True)):
        model = machine.model
        step, places = float(model.opt.timestep), start_places(model)
        for i, name in enumerate(group.sequence_name):
            what = f"sequence {name!r} of {group.name!r}"
            series, control = group.sensordata[i], group.control[i]
            is_finite = bool(np.isfinite(np.asarray(control.data, dtype=float)).all())
            advice = "fill in what was commanded, or cut the log there"
            require(is_finite, f"finite controls in {what}", "NaN or inf", advice)
            control = control.resample(target_dt=step)
            begin, steps = float(control.times[0]), len(control.times)
            own = np.asarray(series.times, dtype=float)
            inside = _inside(own, begin, (steps - 1) * step, step, window, what)
            mapping = _mapping(series, group)
            each = [np.atleast_1d(mapping[s.name][1]).astype(int) for s in signals]
            columns = np.concatenate(each)[list(kept)]
            values = np.asarray(series.data, dtype=float)[inside][:, columns]
            data = np.asarray(control.data, dtype=float)
            actuators = dict(zip(names_of(model, "actuator"), data.T, strict=False))
            for actuator, played in actuators.items():
                require_in_range(model, actuator, played, what)
            state = np.asarray(group.initial_state[i], dtype=float)
            start = {n: float(state[place]) for n, place in places.items()}
            names.append(str(name))
            x.append(values[:, 0] if len(channels) == 1 else values)
            times.append(own[inside] - begin)
            grids.append(step * np.arange(steps))
            starts.append({MODEL: float(k), **start})
            controls.append(actuators)
    same = all(np.array_equal(each, times[0]) for each in times)
    return Trials(
        np.arange(len(x), dtype=float)[:, None],
        x,
        sample_times=times[0] if same else times,
        names=names if len({*names}) == len(names) else None,
        action_labels=["recording"],
        channel_labels=[c.name for c in channels],
        inputs={n: [own[n] for own in controls] for n in controls[0]} or None,
        input_times=grids if controls[0] else None,
        start={n: [own[n] for own in starts] for n in starts[0]},
    )


def _inside(
    times: Array,
    begin: float,
    length: float,
    step: float,
    window: tuple[float, float],
    what: str,
) -> Array:
    """Return the measured times that any delay leaves within the controls."""
    low, high = window
    end = begin + length
    slack = 1e-9 * max(abs(end), step)
    inside = (times >= begin + step - low - slack) & (times <= end - high + slack)
    expected = f"signals measured while the controls of {what} act"
    got = f"none from {begin:g} to {end:g}"
    require(bool(inside.any()), expected, got, "give both in one unit")
    return inside


def _recorded(trials: Trials) -> ActionSpace:
    """Return the space of the recorded sequences."""
    if trials.inputs is None:
        return DiscreteActions(trials.action.float(), names=[RECORDING])
    assert trials.input_times is not None
    played = Recorded(trials.inputs, trials.input_times, names=(RECORDING,))
    return SignalActions(played)


def _noise(trials: Trials) -> AutocorrelatedNoise:
    """Return errors of unknown size and duration, one size a signal."""
    times = trials.sample_times
    assert times is not None
    gap = float(times.diff(dim=-1).nanmedian())
    x = trials.x.double().reshape(*trials.x.shape[:2], -1)
    spread = np.nanstd(x.numpy(), (0, 1))
    spread = np.where(spread > 0, spread, 1.0)
    pairs = [(SHARE * float(sd), float(sd)) for sd in spread]
    span = float(times.nan_to_num(0.0).max())
    return AutocorrelatedNoise.unknown(
        sd=pairs[0] if len(pairs) == 1 else pairs,
        correlation_time=(SHORT * gap, max(LONG * span, gap)),
    )
