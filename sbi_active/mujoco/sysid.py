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
from dataclasses import dataclass
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
from sbi_active.mujoco.models.spec import Source
from sbi_active.mujoco.recordings import require_in_range
from sbi_active.mujoco.residuals import free_parameters, from_residuals
from sbi_active.mujoco.robot import Robot, require_usable, robot_of
from sbi_active.mujoco.sensors import AddedSensor, channels_of
from sbi_active.mujoco.simulator import MODEL, RECORDING, Channel, MujocoFunction
from sbi_active.mujoco.transforms import Signal, SignalReadout
from sbi_active.simulation import AutocorrelatedNoise
from sbi_active.simulation.noise.base import NoiseModel

#: Unknown errors, from this share of a signal's deviation up to all of it, lasting from
#: this share of a sample's distance up to this share of a trial.
SHARE, SHORT, LONG = 1e-4, 0.1, 0.5
#: Endings of signals that are states, by kind.
STATES = {"MjStateQPos": "_qpos", "MjStateQVel": "_qvel"}
SPEED = "MjStateQVel"


@suggests
def from_sysid(
    model_sequences: Any,
    params: Any,
    *,
    transform: Any = None,
    actions: ActionSpace | None = None,
    noise: NoiseModel | float | Tensor | None = None,
    threads: int = 1,
) -> Robot:
    r"""Return a robot from the data and parameters of ``mujoco.sysid``.

    Several ``ModelSequences``, as of a robot with and without a payload, share theta.
    Parameters keep the order of ``params.as_vector()``, and frozen ones their value.

    Args:
        model_sequences: One ``ModelSequences`` or several; or a ``residual_fn`` of
            ``build_residual_fn``, which is taken as a simulator as it is: an outcome is
            then minus its residual, whose measured value is 0.
        params: A ``ParameterDict``; the prior is uniform within its ``get_bounds()``.
        transform: A ``SignalTransform``. Its weights and normalization are not needed
            if noise is declared.
        actions: Actions that the robot may take; None takes the recorded sequences, of
            which the action is the number. Entries are those of
            :class:`.MujocoFunction`; "model" is the number of a ``ModelSequences``.
        noise: Noise of the signals, one or one a signal; None takes autocorrelated
            errors of unknown size, one a signal, and unknown correlation time. A
            ``residual_fn`` needs it.
        threads: Threads of MuJoCo's rollout.

    Raises:
        ValueError: If signals differ between sequences, a signal is not one of the
            model, a control or a measured signal is not finite, or a control is outside
            its range.
    """
    if callable(model_sequences):
        return from_residuals(model_sequences, params, noise=noise)
    groups = _groups(model_sequences)
    edit = _Edit.of(params)
    declared = free_parameters(params)
    signals = _signals(groups)
    machines, channels = [], ()
    for group in groups:
        source, channels = _readable(Source(group.spec), signals)
        machines.append(Machine(source, declared, edit=edit))
    require_usable(machines)
    step = float(machines[0].model.opt.timestep)
    read = [s for s in signals for _ in range(s.width)]
    enabled = None if transform is None else transform._enabled_sensors
    kept = [k for k, s in enumerate(read) if enabled is None or s.name in enabled]
    channels, read = [channels[k] for k in kept], [read[k] for k in kept]
    stamp = step * np.array([s.kind == "MjSensor" for s in read])
    readout = SignalReadout.of(transform, params, [s.name for s in read], stamp)
    sequences = [
        _Sequence.of(k, group, i, signals, step, readout, kept, machines[k].model)
        for k, group in enumerate(groups)
        for i in range(len(group.control))
    ]
    trials = _trials(sequences, channels)
    space = _recorded(trials) if actions is None else actions
    times = trials.sample_times
    grid = times.numpy() if times is not None and times.ndim == 1 else None
    function = MujocoFunction(
        machines,
        channels,
        roles=(RECORDING,) if actions is None else tuple(actions.names),
        times=grid,
        threads=threads,
        readout=readout,
        recorded={k: v.double().numpy() for k, v in (trials.start or {}).items()},
    )
    noise = _noise(trials) if noise is None else noise
    inputs = space if isinstance(space, SignalActions) else None
    return robot_of(function, noise, inputs, space, trials)


@dataclass
class _Edit:
    """Puts parameters into a spec by their modifiers.

    A ``Parameter`` that is pickled loses its modifier: what it has is kept apart.
    """

    each: list[dict[str, Any]]

    @classmethod
    def of(cls, params: Any) -> _Edit:
        """Return the edit of a ``ParameterDict``."""
        return cls([dict(vars(params[name])) for name in params.keys()])  # noqa: SIM118

    def __call__(self, spec: Any, theta: Array) -> None:
        params = self.params()
        params.update_from_vector(np.asarray(theta))
        for name in params.keys():  # noqa: SIM118
            if not params[name].frozen:
                params[name].apply_modifier(spec)

    def params(self) -> Any:
        """Return a ``ParameterDict`` of its own."""
        from mujoco.sysid import Parameter, ParameterDict  # pyright: ignore

        found = ParameterDict()
        for each in self.each:
            parameter = Parameter.__new__(Parameter)
            parameter.__dict__.update(each)
            parameter.value = np.array(each["value"], dtype=float)
            found.add(parameter)
        return found


def _groups(given: Any) -> list[Any]:
    groups = list(given) if isinstance(given, Sequence) else [given]
    parts = "spec", "control", "sensordata", "initial_state"
    if not groups or not all(hasattr(g, part) for g in groups for part in parts):
        raise TypeError(
            f"expected ModelSequences of mujoco.sysid; got {given!r:.80}; pass one or "
            "a list"
        )
    return groups


def _signals(groups: Sequence[Any]) -> list[Signal]:
    """Return the signals that all sequences have."""
    found: list[Signal] = []
    for group in groups:
        for series in group.sensordata:
            own = [
                Signal(name, kind.name, len(np.atleast_1d(places)))
                for name, (kind, places) in _mapping(series, group).items()
            ]
            if found and own != found:
                raise ValueError(
                    f"expected the same signals in all sequences; got "
                    f"{[s.name for s in own]} in {group.name!r} beside "
                    f"{[s.name for s in found]}; slice them by name"
                )
            found = own
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
    edits, reads = [], []
    for signal in signals:
        if signal.kind in STATES:
            joint = signal.name.removesuffix(STATES[signal.kind])
            if joint not in joints:
                raise ValueError(
                    f"expected the state of a hinge or slide; got {signal.name!r}; "
                    "pass sensors of other joints"
                )
            reads.append(f"state {signal.name}")
            what = "velocity" if signal.kind == SPEED else "position"
            edits.append(AddedSensor(reads[-1], joint, what))
        elif signal.kind == "MjSensor":
            reads.append(signal.name)
        else:
            raise ValueError(
                f"expected sensors, positions or velocities; got {signal.name!r} of "
                f"type {signal.kind}; pass a residual_fn, which knows what it is"
            )
    source = source.edited(*edits)
    names = (
        s.name if s.width == 1 else f"{s.name}[{k}]"
        for s in signals
        for k in range(s.width)
    )
    pairs = zip(names, channels_of(source.compile(), reads), strict=True)
    return source, tuple(Channel(name, c.place) for name, c in pairs)


@dataclass
class _Sequence:
    """A recorded sequence, its times from the begin of its control."""

    name: str
    model: int
    start: dict[str, float]
    times: Array
    x: Array
    controls: dict[str, Array]
    grid: Array

    @classmethod
    def of(
        cls,
        k: int,
        group: Any,
        i: int,
        signals: Sequence[Signal],
        step: float,
        readout: SignalReadout,
        kept: Sequence[int],
        model: Any,
    ) -> _Sequence:
        """Return a sequence of a group."""
        what = f"sequence {group.sequence_name[i]!r} of {group.name!r}"
        control = group.control[i].resample(target_dt=step)
        begin = float(control.times[0])
        end = begin + (len(control.times) - 1) * step
        series = group.sensordata[i]
        require(
            bool(np.isfinite(np.asarray(group.control[i].data, dtype=float)).all()),
            f"finite controls in {what}",
            "NaN or inf",
            "fill in what was commanded, or cut the log there",
        )
        mapping = _mapping(series, group)
        columns = np.concatenate(
            [np.atleast_1d(mapping[s.name][1]).astype(int) for s in signals]
        )[list(kept)]
        times = np.asarray(series.times, dtype=float)
        low, high = readout.window
        slack = 1e-9 * max(abs(end), step)
        inside = (times >= begin + step - low - slack) & (times <= end - high + slack)
        if not inside.any():
            raise ValueError(
                f"expected signals measured while the controls of {what} act, "
                f"{begin:g} to {end:g}; got none; give both in one unit"
            )
        names = names_of(model, "actuator")
        data = np.asarray(control.data, dtype=float)
        for j, name in enumerate(names):
            require_in_range(model, name, data[:, j], what)
        state = np.asarray(group.initial_state[i], dtype=float)
        return cls(
            str(group.sequence_name[i]),
            k,
            {n: float(state[place]) for n, place in start_places(model).items()},
            times[inside] - begin,
            np.asarray(series.data, dtype=float)[inside][:, columns],
            {name: data[:, j] for j, name in enumerate(names)},
            step * np.arange(len(data)),
        )


def _trials(sequences: Sequence[_Sequence], channels: Sequence[Channel]) -> Trials:
    """Return sequences as trials, of which the action is the number."""
    single = len(channels) == 1
    times = [s.times for s in sequences]
    same = all(len(t) == len(times[0]) and (t == times[0]).all() for t in times)
    controls = {
        name: [s.controls[name] for s in sequences] for name in sequences[0].controls
    }
    return Trials(
        np.arange(len(sequences), dtype=float)[:, None],
        [s.x[:, 0] if single else s.x for s in sequences],
        sample_times=times[0] if same else times,
        names=[s.name for s in sequences]
        if len({s.name for s in sequences}) == len(sequences)
        else None,
        action_labels=["recording"],
        channel_labels=[c.name for c in channels],
        inputs=controls or None,
        input_times=[s.grid for s in sequences] if controls else None,
        start={
            MODEL: [float(s.model) for s in sequences],
            **{name: [s.start[name] for s in sequences] for name in sequences[0].start},
        },
    )


def _recorded(trials: Trials) -> ActionSpace:
    """Return the space of the recorded sequences."""
    if trials.inputs is None:
        return DiscreteActions(trials.action.float(), names=[RECORDING])
    assert trials.input_times is not None
    played = Recorded(trials.inputs, trials.input_times, names=(RECORDING,))
    return SignalActions(played)


def _noise(trials: Trials) -> AutocorrelatedNoise:
    """Return errors of unknown size and duration, one size a signal."""
    x = trials.x.double()
    x = x.reshape(*x.shape[:2], -1)
    times = trials.sample_times
    assert times is not None
    gap = float(times.diff(dim=-1)[times.diff(dim=-1).isfinite()].median())
    spread = np.nanstd(x.numpy(), (0, 1))
    spread = np.where(spread > 0, spread, 1.0)
    pairs = [(SHARE * float(sd), float(sd)) for sd in spread]
    span = float(times.nan_to_num(0.0).max())
    return AutocorrelatedNoise.unknown(
        sd=pairs[0] if len(pairs) == 1 else pairs,
        correlation_time=(SHORT * gap, max(LONG * span, gap)),
    )
