"""Changes of a value by an effect: what an actuator or a sensor makes of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sbi_active.criticism.effects.effect import Context
from sbi_active.criticism.effects.series import (
    at_times,
    delayed_input,
    delayed_samples,
    lagged_input,
    lagged_samples,
    played,
    rounded,
)


@dataclass(frozen=True)
class Wrapped:
    """A change of an action, of some inputs over time, or of x.

    Attributes:
        what: Name of the change in :data:`CHANGES`.
        inputs: Names of the inputs that it changes alike; () changes the value itself.
        channel: Entry of x's last axis that alone is changed; None changes all.
    """

    what: str
    inputs: tuple[str, ...] = ()
    channel: int | None = None

    def __call__(
        self, value: Any, phi: Tensor, action: Tensor, context: Context
    ) -> Any:
        """Return the value changed."""
        change = CHANGES[self.what]
        if self.inputs:
            return {**value, **{n: change(value[n], phi, context) for n in self.inputs}}
        if self.channel is None:
            return change(value, phi, context)
        parts = [*value.split(1, -1)]
        parts[self.channel] = change(parts[self.channel], phi, context)
        return torch.cat(parts, -1)


def _lift(phi: Tensor, value: Tensor) -> Tensor:
    """Return phi shaped to act on the last axis of a value."""
    return phi.reshape(len(phi), *[1] * (value.ndim - 2), phi.shape[1])


def _limited(value: Tensor, limit: Tensor) -> Tensor:
    return torch.minimum(torch.maximum(value, -limit), limit)


def _since_start(x: Tensor, context: Context) -> Tensor:
    """Return the time since the first sample, of a shape that acts on x."""
    times = _times(x, context)
    return (times - times[:, :1]).reshape(*times.shape, *[1] * (x.ndim - 2))


def _times(x: Tensor, context: Context) -> Tensor:
    if context.times is None:
        raise ValueError(
            "expected sample times for an effect along them; got none; give "
            "SimulatorModel(sample_times=...) or Trials(sample_times=...)"
        )
    return context.times.to(x.dtype).expand(len(x), -1)


def _step(context: Context) -> Tensor:
    assert context.input_times is not None
    return context.input_times[1] - context.input_times[0]


#: Changes of a value by phi, shape (n, k), which acts on its last axis.
CHANGES: dict[str, Callable[[Tensor, Tensor, Context], Tensor]] = {
    "offset": lambda x, phi, c: x + _lift(phi, x),
    "gain": lambda x, phi, c: x * (1 + _lift(phi, x)),
    "limit": lambda x, phi, c: _limited(x, _lift(phi, x)),
    "log limit": lambda x, phi, c: _limited(x, _lift(phi.exp(), x)),
    "dead zone": lambda x, phi, c: x.sign() * (x.abs() - _lift(phi, x)).clamp(min=0),
    "backlash": lambda u, phi, c: played(u, phi),
    "input delay": lambda u, phi, c: delayed_input(u, phi, _step(c)),
    "input lag": lambda u, phi, c: lagged_input(u, phi, _step(c)),
    "drift by trial": lambda x, phi, c: x + _lift(phi * c.index[:, None], x),
    "drift in time": lambda x, phi, c: x + _lift(phi, x) * _since_start(x, c),
    "clock": lambda x, phi, c: at_times(x, _times(x, c) + phi, _times(x, c)),
    "delay": lambda x, phi, c: delayed_samples(x, phi, _times(x, c)),
    "lag": lambda x, phi, c: lagged_samples(x, phi, _times(x, c)),
    "quantum": lambda x, phi, c: rounded(x, _lift(phi, x)),
}
