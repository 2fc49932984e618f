r"""Signals that a robot can play, as functions of a few parameters.

References:
    Schroeder, IEEE Transactions on Information Theory 16 (1970), 85-89, for the phases
    of a multisine; Pintelon & Schoukens, System Identification (2012), for the rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from sbi_active.arrays import own_tensor
from sbi_active.expected import require


@dataclass(frozen=True)
class Waveform:
    """A signal whose parameters are the action, but for those that are fixed.

    Attributes:
        shape: Shape of the signal, "chirp", "step" or "multisine".
        input: Name of the input.
        every: Names of all parameters, each with its unit.
        fixed: Values of some.
        frequencies: Frequencies of a multisine, Hz.
    """

    shape: str
    input: str
    every: tuple[tuple[str, str], ...]
    fixed: dict[str, float] = field(default_factory=dict)
    frequencies: tuple[float, ...] = ()

    @property
    def names(self) -> list[str]:
        """Names of the entries of the action."""
        return [name for name, _ in self.every if name not in self.fixed]

    @property
    def units(self) -> list[str]:
        """Units of the parameters."""
        return [unit for name, unit in self.every if name not in self.fixed]

    def __call__(self, action: Tensor, input_times: Tensor) -> dict[str, Tensor]:
        """Return the signal, {name: (n, m)}.

        Args:
            action: Actions, shape (n, action_dim).
            input_times: Times of the inputs, shape (m,).
        """
        if action.shape[1] != len(self.names):
            raise ValueError(
                f"expected actions of {', '.join(self.names)}; got {action.shape[1]} "
                "entries; give one each, or fix some by name"
            )
        one = torch.ones(len(action), dtype=action.dtype)
        given = {name: value * one for name, value in self.fixed.items()}
        given |= dict(zip(self.names, action.unbind(1), strict=True))
        every = [given[name][:, None] for name, _ in self.every]
        return {self.input: _SHAPES[self.shape](self, every, input_times)}


def chirp(input: str = "input", **fixed: float) -> Waveform:  # noqa: A002
    r"""Return a sine whose frequency goes linearly from one to another,

    .. math::
        u(t) = A \sin 2 \pi \left(f_0 t + \frac{f_1 - f_0}{2 T} t^2\right),

    with t from the grid's first time and T its span.

    Args:
        input: Name of the input.
        **fixed: Any of amplitude, start_frequency and end_frequency (Hz) that is the
            same in all actions; the others are the action, in this order.
    """  # noqa: D205, D400, D415
    every = (("amplitude", ""), ("start frequency", "Hz"), ("end frequency", "Hz"))
    return Waveform("chirp", input, every, _fixed(every, fixed))


def step(input: str = "input", **fixed: float) -> Waveform:  # noqa: A002
    r"""Return a signal that is A from ``begin`` for ``length`` and 0 before and after.

    Args:
        input: Name of the input.
        **fixed: Any of amplitude, begin and length (s), as in :func:`chirp`.
    """
    every = (("amplitude", ""), ("begin", "s"), ("length", "s"))
    return Waveform("step", input, every, _fixed(every, fixed))


def multisine(frequencies: Sequence[float], input: str = "input") -> Waveform:  # noqa: A002
    r"""Return a sum of sines with Schroeder's phases, which keep its peaks low,

    .. math::
        u(t) = \sum_{j=1}^J A_j \sin(2 \pi f_j t - \pi j (j - 1) / J).

    Args:
        frequencies: f, Hz; the action is one amplitude each.
        input: Name of the input.
    """  # noqa: D205, D400, D415
    every = tuple((f"amplitude at {f:g} Hz", "") for f in frequencies)
    return Waveform("multisine", input, every, {}, tuple(map(float, frequencies)))


@dataclass(frozen=True)
class Together:
    """Signals of several inputs at once, the entries of one behind those of another.

    Attributes:
        parts: Waveforms, one an input.
    """

    parts: tuple[Waveform, ...]

    @property
    def names(self) -> list[str]:
        """Names of the entries of the action, with the input."""
        return [f"{part.input} {name}" for part in self.parts for name in part.names]

    @property
    def units(self) -> list[str]:
        """Units of the parameters."""
        return [unit for part in self.parts for unit in part.units]

    def __call__(self, action: Tensor, input_times: Tensor) -> dict[str, Tensor]:
        """Return the signals, {name: (n, m)}.

        Args:
            action: Actions, shape (n, action_dim).
            input_times: Times of the inputs, shape (m,).
        """
        found: dict[str, Tensor] = {}
        sizes = [len(part.names) for part in self.parts]
        for part, entries in zip(self.parts, action.split(sizes, 1), strict=True):
            found |= part(entries, input_times)
        return found


def together(*waveforms: Waveform) -> Together:
    """Return the signals of several inputs, such as the joints of an arm, as one.

    Args:
        *waveforms: Waveforms, one an input.

    Raises:
        ValueError: If there is none, or two are of the same input.

    Example:
        >>> both = together(chirp("hip", amplitude=0.2), chirp("knee", amplitude=0.3))
        >>> both.names[1:3]
        ['hip end frequency', 'knee start frequency']
    """
    inputs = [waveform.input for waveform in waveforms]
    if not inputs or len({*inputs}) < len(inputs):
        raise ValueError(
            f"expected waveforms of different inputs; got {inputs}; name them, as "
            "in chirp('knee')"
        )
    return Together(waveforms)


@dataclass(frozen=True, eq=False)
class Recorded:
    """Inputs that were recorded; the action is their number.

    Attributes:
        inputs: Inputs by name, shape (t, m).
        input_times: Times of the inputs, shape (m,).
        values: The actions, shape (t, 1).
    """

    inputs: dict[str, Tensor]
    input_times: Tensor
    names: tuple[str, ...] = ("trial",)

    @property
    def values(self) -> Tensor:
        """All actions."""
        num = len(next(iter(self.inputs.values())))
        return torch.arange(num).float()[:, None]

    def __call__(self, action: Tensor, input_times: Tensor) -> dict[str, Tensor]:
        """Return the inputs of some trials, {name: (n, m)}.

        Args:
            action: Numbers of the recordings, shape (n, 1).
            input_times: The grid of the recordings, shape (m,).
        """
        number = action[:, 0].round().long()
        num = len(self.values)
        fits, some = bool(((number >= 0) & (number < num)).all()), number.tolist()[:6]
        advice = "pass the number of a recorded one"
        require(fits, f"trials 0 to {num - 1}", some, advice)
        own, given = len(self.input_times), len(input_times)
        expected = f"the recordings' own {own} input_times"
        require(given == own, expected, given, "leave input_times out")
        return {name: u[number].to(action.dtype) for name, u in self.inputs.items()}


def recorded(trials: Any) -> Recorded:
    """Return the inputs of measured trials, of which an action is the number.

    Args:
        trials: ``Trials`` with inputs, counted from 0 in their order.
    """
    if getattr(trials, "inputs", None) is None:
        raise ValueError(
            "expected trials with inputs over time; got none; pass Trials(inputs=...)"
        )
    own = {name: own_tensor(u, torch.float64) for name, u in trials.inputs.items()}
    return Recorded(own, own_tensor(trials.input_times, torch.float64))


def _fixed(
    every: Sequence[tuple[str, str]], given: dict[str, float]
) -> dict[str, float]:
    known = [name for name, _ in every]
    found = {name.replace("_", " "): float(value) for name, value in given.items()}
    unknown = {*found} - {*known}
    expected, got = f"some of {', '.join(known)} to be fixed", sorted(unknown)
    require(not unknown, expected, ", ".join(got), "correct the name")
    return found


def _chirp(waveform: Waveform, every: list[Tensor], times: Tensor) -> Tensor:
    amplitude, first, last = every
    t = times - times[0]
    turns = first * t + (last - first) * t**2 / (2 * t[-1])
    return amplitude * torch.sin(2 * math.pi * turns)


def _step(waveform: Waveform, every: list[Tensor], times: Tensor) -> Tensor:
    amplitude, begin, length = every
    on = (times >= begin) & (times < begin + length)
    return amplitude * on.to(amplitude.dtype)


def _multisine(waveform: Waveform, every: list[Tensor], times: Tensor) -> Tensor:
    j = torch.arange(1, len(every) + 1, dtype=times.dtype)
    f = torch.tensor(waveform.frequencies, dtype=times.dtype)
    phase = 2 * math.pi * f * times[:, None] - math.pi * j * (j - 1) / len(every)
    return torch.cat(every, 1) @ torch.sin(phase).T


_SHAPES = {"chirp": _chirp, "step": _step, "multisine": _multisine}
