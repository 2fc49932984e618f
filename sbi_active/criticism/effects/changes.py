"""Changes of a value by an effect: what an actuator or a sensor makes of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sbi_active.criticism.effects.effect import Context
from sbi_active.expected import require


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


def _since_start(x: Tensor, context: Context) -> Tensor:
    """Return the time since the first sample, of a shape that acts on x."""
    times = _times(x, context)
    return (times - times[:, :1]).reshape(*times.shape, *[1] * (x.ndim - 2))


def _times(x: Tensor, context: Context) -> Tensor:
    expected, times = "sample times for an effect along them", context.times
    advice = "give SimulatorModel(sample_times=...) or Trials(sample_times=...)"
    require(times is not None, expected, "none", advice)
    assert times is not None
    return times.to(x.dtype).expand(len(x), -1)


def _step(context: Context) -> Tensor:
    assert context.input_times is not None
    return context.input_times[1] - context.input_times[0]


#: Changes of a value by phi, shape (n, k), which acts on its last axis.
CHANGES: dict[str, Callable[[Tensor, Tensor, Context], Tensor]] = {
    "offset": lambda x, phi, c: x + _lift(phi, x),
    "gain": lambda x, phi, c: x * (1 + _lift(phi, x)),
    "limit": lambda x, phi, c: x.clamp(-_lift(phi, x), _lift(phi, x)),
    "log limit": lambda x, phi, c: x.clamp(-_lift(phi.exp(), x), _lift(phi.exp(), x)),
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


def lagged_input(u: Tensor, tau: Tensor, step: Tensor) -> Tensor:
    """Return a held series behind a first-order lag, its mean over each step.

    Args:
        u: Series, shape (n, m), at rest before.
        tau: Time constant, 0 for none, shape (n, 1).
        step: Step of the grid.
    """
    tau = tau.clamp(min=0)
    keep = torch.exp(-step / tau)
    y = _affine(keep.expand_as(u[:, 1:]), (1 - keep) * u[:, :-1], u[:, :1])
    return u + (y - u) * (tau / step) * (1 - keep)


def delayed_input(u: Tensor, tau: Tensor, step: Tensor) -> Tensor:
    """Return a held series later by tau, its mean over each step.

    Args:
        u: Series, shape (n, m); its first value held before.
        tau: Delay, shape (n, 1).
        step: Step of the grid.
    """
    place = torch.arange(u.shape[1], dtype=u.dtype) - tau / step
    place = place.clamp(0, u.shape[1] - 1)
    low = place.long().clamp(max=u.shape[1] - 2)
    part = place - low
    return (1 - part) * u.gather(1, low) + part * u.gather(1, low + 1)


def played(u: Tensor, width: Tensor) -> Tensor:
    r"""Return a series behind a backlash, :math:`|y_k - u_k| \le w / 2`.

    Args:
        u: Series, shape (n, m); it starts in the middle of the play.
        width: w, shape (n, 1).
    """
    half = width.clamp(min=0)[:, 0] / 2
    places = [u[:, 0]]
    for each in u[:, 1:].unbind(1):
        places.append(places[-1].clamp(each - half, each + half))
    return torch.stack(places, 1)


def lagged_samples(x: Tensor, tau: Tensor, times: Tensor) -> Tensor:
    """Return samples by a sensor with a first-order lag, at rest before the first.

    Args:
        x: Observations, shape (n, k, ...), a line between its samples.
        tau: Time constant, 0 for none, shape (n, 1).
        times: Times, shape (n, k); what pads a shorter trial has the time of its last
            sample.
    """
    if x.shape[1] < 2:
        return x
    tau = tau.clamp(min=0)
    gap = times.diff(dim=1)
    keep = torch.exp(-gap / tau).where(gap > 0, torch.ones_like(gap))
    gap = gap.where(gap > 0, torch.ones_like(gap))
    shape = (*keep.shape, *[1] * (x.ndim - 2))
    keep, gap = keep.reshape(shape), gap.reshape(shape)
    behind = tau.reshape(-1, *[1] * (x.ndim - 1)) * x.diff(dim=1) / gap
    # y - x follows the lag of what the slope leaves behind.
    rest = _affine(keep.expand_as(behind), -behind * (1 - keep), 0 * x[:, :1])
    return x + rest


def delayed_samples(x: Tensor, tau: Tensor, times: Tensor) -> Tensor:
    """Return samples of what was there tau before, the first value before it.

    Args:
        x: Samples, as in :func:`lagged_samples`.
        tau: Delay, shape (n, 1).
        times: Sample times, as in :func:`lagged_samples`.
    """
    return at_times(x, (times - tau).clamp(times[:, :1], times[:, -1:]), times)


def at_times(x: Tensor, wanted: Tensor, times: Tensor) -> Tensor:
    """Return samples at other times, linear between samples and beyond the ends.

    Args:
        x: Samples, as in :func:`lagged_samples`.
        wanted: Times that are wanted, shape (n, m).
        times: Sample times, as in :func:`lagged_samples`.
    """
    if x.shape[1] < 2:
        return x
    times, wanted = times.contiguous(), wanted.contiguous()
    last = times.shape[1] - 2
    low = (torch.searchsorted(times, wanted, right=True) - 1).clamp(0, last)
    gap = times.gather(1, low + 1) - times.gather(1, low)
    # What pads a shorter trial has the time of its last sample.
    gap = gap.where(gap > 0, torch.ones_like(gap))
    weight = (wanted - times.gather(1, low)) / gap
    shape = (*low.shape, *[1] * (x.ndim - 2))
    index = low.reshape(shape).expand(*low.shape, *x.shape[2:])
    weight = weight.reshape(shape)
    return (1 - weight) * x.gather(1, index) + weight * x.gather(1, index + 1)


def rounded(x: Tensor, quantum: Tensor) -> Tensor:
    """Return samples to the nearest multiple of a quantum, 0 for as they are.

    Args:
        x: Observations, shape (n, ...).
        quantum: Quantum, of the shape of x or of one that broadcasts to it.
    """
    quantum = quantum.expand_as(x)
    safe = quantum.where(quantum > 0, torch.ones_like(quantum))
    return torch.where(quantum > 0, torch.round(x / safe) * safe, x)


def _affine(factor: Tensor, shift: Tensor, start: Tensor) -> Tensor:
    """Return y with y_0 = start and y_{k+1} = factor_k y_k + shift_k.

    Args:
        factor: Factors, shape (n, k - 1, ...).
        shift: Shift of each step, of the same shape.
        start: Start values, shape (n, 1, ...).
    """
    reach = 1
    while reach < factor.shape[1]:
        first, later = slice(None, -reach), slice(reach, None)
        shift = torch.cat(
            [shift[:, :reach], shift[:, later] + factor[:, later] * shift[:, first]], 1
        )
        factor = torch.cat([factor[:, :reach], factor[:, later] * factor[:, first]], 1)
        reach *= 2
    return torch.cat([start, factor * start + shift], 1)
