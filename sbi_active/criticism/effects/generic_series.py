"""Generic effects of what varies in time: actuators on inputs, sensors on samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.distributions import (
    Distribution,
    HalfNormal,
    Independent,
    Normal,
    Uniform,
)

from sbi_active.criticism.effects.effect import Context, Effect
from sbi_active.criticism.effects.series import (
    delayed_input,
    delayed_samples,
    lagged_input,
    lagged_samples,
    played,
    rounded,
)

#: Relative error of an actuator, one prior deviation.
GAIN = 0.1
#: Offset, dead zone and backlash of an actuator, in ranges of its input.
OFFSET = 0.05
#: Where an actuator saturates, in largest inputs.
LIMIT = (0.3, 1.0)
#: Delays and lags, in spans of a recording, and at most in its steps.
LATE, STEPS = 0.02, 10.0
#: Quantum of a sensor, and its drift over a recording, in deviations of its noise.
QUANTUM, DRIFT = 5.0, 5.0

#: Kinds of lateness: what they are called, what they do, and how reports say it.
LATE_INPUTS = (
    ("delay", delayed_input, "later"),
    ("lag", lagged_input, "behind a first-order lag"),
)
LATE_SAMPLES = (
    ("delay", delayed_samples, "what was there before"),
    ("lag", lagged_samples, "behind a first-order lag"),
)

Change = Callable[[Tensor, Tensor, Context], Tensor]


def typical_delay(times: Tensor) -> float:
    """Return one prior deviation of delays and lags, s.

    Args:
        times: Sample times of one recording, or of several, shape (k,) or (t, k), NaN
            for none.
    """
    rows = times.reshape(-1, times.shape[-1]).double()
    known = [row[row.isfinite()] for row in rows]
    span = max(float(row.max() - row.min()) for row in known)
    gaps = torch.cat([row.diff() for row in known])
    step = float(gaps[gaps > 0].median()) if bool((gaps > 0).any()) else span
    return min(LATE * span, STEPS * step)


def of_inputs(
    inputs: Mapping[str, Tensor], delay: float, units: Mapping[str, str]
) -> list[Effect]:
    """Return effects of an actuator on each input.

    Args:
        inputs: Inputs by name, shape (t, m).
        delay: One prior deviation of delays and lags, s.
        units: Units of the inputs, by name.
    """
    found = []
    for name, value in inputs.items():
        before = f"{name} " if len(inputs) > 1 else ""
        found += _of_input(name, before, value, delay, units.get(name, ""))
    return found


def _of_input(
    name: str, before: str, value: Tensor, delay: float, units: str
) -> list[Effect]:
    low, high = float(value.min()), float(value.max())
    largest = max(abs(low), abs(high))
    if largest == 0:
        return []
    width = high - low if high > low else largest
    called = before or "input "
    who = f"the input {name}"

    def make(what: str, change: Change, prior: Distribution, **options: Any) -> Effect:
        return Effect(
            what,
            hook="input",
            prior=Independent(prior, 1),
            apply=_OfInput(name, change),
            **{"null": 0.0, **options},
        )

    found = [
        make(
            f"{called}gain",
            _gain,
            _normal(GAIN),
            describe=f"what acts is a multiple of {who}",
        ),
        make(
            f"{called}offset",
            _offset,
            _normal(OFFSET * width),
            units=units,
            describe=f"what acts is shifted from {who}",
        ),
        make(
            f"{called}saturation",
            _clamp,
            _between(LIMIT[0] * largest, LIMIT[1] * largest),
            null=torch.inf,
            units=units,
            describe=f"{who} acts up to a limit",
        ),
    ]
    if low < 0 < high:
        found.append(
            make(
                f"{before}dead zone",
                _dead_zone,
                _half(OFFSET * width),
                units=units,
                describe=f"{who} acts smaller by a constant, and not where it is small",
            )
        )
    if bool((value.diff(dim=1) != 0).any()):
        found += [
            *[
                make(
                    f"{called}{kind}",
                    partial(_late, change=change),
                    _half(delay),
                    units="s",
                    describe=f"{who} acts {how}",
                )
                for kind, change, how in LATE_INPUTS
            ],
            make(
                f"{before}backlash",
                _backlash,
                _half(OFFSET * width),
                units=units,
                describe=f"{who} acts after a play at each turn",
            ),
        ]
    return found


def of_samples(sd: Tensor, times: Tensor) -> list[Effect]:
    """Return effects of a sensor along its samples.

    Args:
        sd: Standard deviation of its noise, one or one a channel.
        times: Times of the samples, shape (k,) or (t, k), NaN for none.
    """
    delay = _half(typical_delay(times))
    span = float(times.nan_to_num(-torch.inf).max() - times.nan_to_num(torch.inf).min())
    make = partial(Effect, hook="observation", null=0.0)
    return [
        make(
            "drift in time",
            prior=Independent(Normal(torch.zeros_like(sd), DRIFT * sd / span), 1),
            apply=_creep,
            units="1/s",
            describe="the sensor's bias grows along each recording",
        ),
        *[
            make(
                f"sensor {kind}",
                prior=Independent(delay, 1),
                apply=partial(_of_x, change=change),
                units="s",
                describe=f"the sensor reads {how}",
            )
            for kind, change, how in LATE_SAMPLES
        ],
        make(
            "sensor quantum",
            prior=Independent(HalfNormal(QUANTUM * sd), 1),
            apply=_round,
            describe="the sensor reads multiples of a step",
        ),
    ]


def on_channel(effect: Effect, channel: int, name: str) -> Effect:
    """Return an effect of one sensor, on its channel alone.

    Args:
        effect: Effect on an observation of one channel.
        channel: Entry of x's last axis.
        name: Name in reports.
    """
    return replace(
        effect,
        name=f"{name} {effect.name}",
        apply=_OnChannel(channel, effect.apply),
        describe=f"{name}: {effect.describe}",
    )


@dataclass(frozen=True)
class _OnChannel:
    """Changes one channel."""

    channel: int
    change: Callable[..., Any]

    def __call__(
        self, x: Tensor, phi: Tensor, action: Tensor, context: Context
    ) -> Tensor:
        parts = [*x.split(1, -1)]
        parts[self.channel] = self.change(parts[self.channel], phi, action, context)
        return torch.cat(parts, -1)


@dataclass(frozen=True)
class _OfInput:
    """Changes one input."""

    name: str
    change: Change

    def __call__(
        self, value: dict[str, Tensor], phi: Tensor, action: Tensor, context: Context
    ) -> dict[str, Tensor]:
        return {**value, self.name: self.change(value[self.name], phi, context)}


def _normal(sd: float) -> Distribution:
    return Normal(torch.zeros(1).double(), torch.tensor([sd]).double())


def _between(low: float, high: float) -> Distribution:
    return Uniform(torch.tensor([low]).double(), torch.tensor([high]).double())


def _half(sd: float) -> Distribution:
    return HalfNormal(torch.tensor([sd]).double())


def _gain(u: Tensor, phi: Tensor, context: Context) -> Tensor:
    return u * (1 + phi)


def _offset(u: Tensor, phi: Tensor, context: Context) -> Tensor:
    return u + phi


def _clamp(u: Tensor, phi: Tensor, context: Context) -> Tensor:
    return torch.minimum(torch.maximum(u, -phi), phi)


def _dead_zone(u: Tensor, phi: Tensor, context: Context) -> Tensor:
    return u.sign() * (u.abs() - phi).clamp(min=0)


def _backlash(u: Tensor, phi: Tensor, context: Context) -> Tensor:
    return played(u, phi)


def _late(u: Tensor, phi: Tensor, context: Context, *, change: Any) -> Tensor:
    assert context.input_times is not None
    return change(u, phi, context.input_times[1] - context.input_times[0])


def _sample_times(x: Tensor, context: Context) -> Tensor:
    if context.times is None:
        raise ValueError(
            "expected sample times for an effect along them; got none; give "
            "Trials(sample_times=...)"
        )
    return context.times.to(x.dtype).expand(len(x), -1)


def _of_x(
    x: Tensor, phi: Tensor, action: Tensor, context: Context, *, change: Any
) -> Tensor:
    return change(x, phi, _sample_times(x, context))


def _creep(x: Tensor, phi: Tensor, action: Tensor, context: Context) -> Tensor:
    times = _sample_times(x, context)
    since = (times - times[:, :1]).reshape(*times.shape, *[1] * (x.ndim - 2))
    return x + _along(phi, x) * since


def _round(x: Tensor, phi: Tensor, action: Tensor, context: Context) -> Tensor:
    return rounded(x, _along(phi, x))


def _along(phi: Tensor, x: Tensor) -> Tensor:
    """Return phi (n, c) shaped to act on the last axis of x."""
    return phi.reshape(len(phi), *[1] * (x.ndim - 2), phi.shape[1])
