"""Changes of a value by an effect: what an actuator or a sensor makes of it.

Each takes ``(value, phi, action, context)``, as ``Effect.apply`` does: phi, shape (n,
k), acts on the last axis of the value.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from sbi_active.criticism.effects.effect import Context
from sbi_active.criticism.effects.series import played, rounded

Change = Callable[[Tensor, Tensor, Tensor, Context], Tensor]
#: A change of a series by phi and the step, or the times, of its samples.
InTime = Callable[[Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class OnInput:
    """Changes one input over time."""

    name: str
    change: Change

    def __call__(
        self, value: dict[str, Tensor], phi: Tensor, action: Tensor, context: Context
    ) -> dict[str, Tensor]:
        """Return the inputs with that one changed."""
        own = self.change(value[self.name], phi, action, context)
        return {**value, self.name: own}


@dataclass(frozen=True)
class OnChannel:
    """Changes one entry of x's last axis."""

    channel: int
    change: Change

    def __call__(
        self, x: Tensor, phi: Tensor, action: Tensor, context: Context
    ) -> Tensor:
        """Return x with that channel changed."""
        parts = [*x.split(1, -1)]
        parts[self.channel] = self.change(parts[self.channel], phi, action, context)
        return torch.cat(parts, -1)


@dataclass(frozen=True)
class AlongInput:
    """Changes a series on the uniform grid of the inputs."""

    change: InTime

    def __call__(
        self, u: Tensor, phi: Tensor, action: Tensor, context: Context
    ) -> Tensor:
        """Return the series changed."""
        assert context.input_times is not None
        return self.change(u, phi, context.input_times[1] - context.input_times[0])


@dataclass(frozen=True)
class AlongSamples:
    """Changes x along its sample times."""

    change: InTime

    def __call__(
        self, x: Tensor, phi: Tensor, action: Tensor, context: Context
    ) -> Tensor:
        """Return x changed."""
        return self.change(x, phi, _sample_times(x, context))


def add(value: Tensor, phi: Tensor, action: Tensor, context: Context) -> Tensor:
    """Return the value with phi added."""
    return value + _lift(phi, value)


def scale(value: Tensor, phi: Tensor, action: Tensor, context: Context) -> Tensor:
    """Return the value times 1 + phi."""
    return value * (1 + _lift(phi, value))


def drift(value: Tensor, phi: Tensor, action: Tensor, context: Context) -> Tensor:
    """Return the value with phi added from trial to trial."""
    return value + _lift(phi * context.index[:, None], value)


def clamp(value: Tensor, phi: Tensor, action: Tensor, context: Context) -> Tensor:
    """Return the value within limits of phi."""
    limit = _lift(phi, value)
    return torch.minimum(torch.maximum(value, -limit), limit)


def clamp_log(value: Tensor, phi: Tensor, action: Tensor, context: Context) -> Tensor:
    """Return the value within limits whose logarithm is phi."""
    return clamp(value, phi.exp(), action, context)


def dead_zone(value: Tensor, phi: Tensor, action: Tensor, context: Context) -> Tensor:
    """Return the value nearer to zero by phi."""
    return value.sign() * (value.abs() - _lift(phi, value)).clamp(min=0)


def backlash(u: Tensor, phi: Tensor, action: Tensor, context: Context) -> Tensor:
    """Return a series behind a play of phi."""
    return played(u, phi)


def quantize(x: Tensor, phi: Tensor, action: Tensor, context: Context) -> Tensor:
    """Return multiples of phi."""
    return rounded(x, _lift(phi, x))


def creep(x: Tensor, phi: Tensor, action: Tensor, context: Context) -> Tensor:
    """Return x with a bias that grows along each recording."""
    times = _sample_times(x, context)
    since = (times - times[:, :1]).reshape(*times.shape, *[1] * (x.ndim - 2))
    return x + _lift(phi, x) * since


def shift_in_time(x: Tensor, phi: Tensor, action: Tensor, context: Context) -> Tensor:
    """Return x at times + phi, linear between samples and beyond the ends."""
    times = _sample_times(x, context).contiguous()
    wanted = (times + phi).contiguous()
    last = times.shape[1] - 2
    low = (torch.searchsorted(times, wanted, right=True) - 1).clamp(0, last)
    step = times.gather(1, low + 1) - times.gather(1, low)
    # What pads a shorter trial has the time of its last sample.
    step = step.where(step > 0, torch.ones_like(step))
    weight = (wanted - times.gather(1, low)) / step
    shape = (*low.shape, *[1] * (x.ndim - 2))
    index = low.reshape(shape).expand_as(x)
    weight = weight.reshape(shape)
    return (1 - weight) * x.gather(1, index) + weight * x.gather(1, index + 1)


def _lift(phi: Tensor, value: Tensor) -> Tensor:
    """Return phi shaped to act on the last axis of a value."""
    return phi.reshape(len(phi), *[1] * (value.ndim - 2), phi.shape[1])


def _sample_times(x: Tensor, context: Context) -> Tensor:
    if context.times is None:
        raise ValueError(
            "expected sample times for an effect along them; got none; give "
            "SimulatorModel(sample_times=...) or Trials(sample_times=...)"
        )
    return context.times.to(x.dtype).expand(len(x), -1)
