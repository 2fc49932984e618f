"""Generic effects of actuators, and of sensors along their samples."""

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

from sbi_active.criticism.effects import changes
from sbi_active.criticism.effects.changes import (
    AlongInput,
    AlongSamples,
    Change,
    OnChannel,
    OnInput,
)
from sbi_active.criticism.effects.effect import Effect
from sbi_active.criticism.effects.series import (
    delayed_input,
    delayed_samples,
    lagged_input,
    lagged_samples,
)


@dataclass(frozen=True, kw_only=True)
class Scales:
    """Prior deviations of generic effects, of which half or twice changes odds little.

    Attributes:
        gain: Relative error of an actuator or sensor.
        offset: Offset, dead zone and backlash of an actuator, in ranges of its input.
        limit: Where an actuator saturates, in largest inputs.
        bias: Bias of a sensor, in deviations of its noise.
        drift: Drift of a sensor a trial, in deviations of its noise.
        creep: Drift of a sensor over a recording, in deviations of its noise.
        quantum: Quantum of a sensor, in deviations of its noise.
        range: Where a sensor saturates, in deviations of the prior predictive.
        late: Delays, lags and a clock's error, in spans of a recording.
        steps: Steps of a recording that delays and lags are at most.
    """

    gain: float = 0.1
    offset: float = 0.05
    limit: tuple[float, float] = (0.3, 1.0)
    bias: float = 5.0
    drift: float = 1.0
    creep: float = 5.0
    quantum: float = 5.0
    range: tuple[float, float] = (0.1, 10.0)
    late: float = 0.02
    steps: float = 10.0


SCALES = Scales()


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
    return min(SCALES.late * span, SCALES.steps * step)


def of_actuator(
    make: Callable[..., Effect], some: Tensor, called: str, before: str, who: str
) -> list[Effect]:
    """Return gain, offset, saturation and dead zone of an actuator.

    Args:
        make: Constructor of an effect from name, prior, null, apply and description.
        some: Commands, shape (n, k).
        called: Beginning of the effects' names.
        before: Beginning of the dead zone's name.
        who: Name of the command in descriptions.
    """
    low, high = some.min(0).values, some.max(0).values
    width = torch.where(high > low, high - low, high.abs().clamp(min=1e-12))
    largest = some.abs().max(0).values.clamp(min=1e-12)
    least, most = SCALES.limit
    found = [
        make(
            f"{called}gain",
            prior=normal(torch.full_like(width, SCALES.gain)),
            null=0.0,
            apply=changes.scale,
            units="",
            describe=f"what acts is a multiple of {who}",
        ),
        make(
            f"{called}offset",
            prior=normal(SCALES.offset * width),
            null=0.0,
            apply=changes.add,
            describe=f"what acts is shifted from {who}",
        ),
        make(
            f"{called}saturation",
            prior=Independent(Uniform(least * largest, most * largest), 1),
            null=torch.inf,
            apply=changes.clamp,
            describe=f"{who} acts up to a limit",
        ),
    ]
    if bool(((low < 0) & (high > 0)).any()):
        found.append(
            make(
                f"{before}dead zone",
                prior=_half(SCALES.offset * width),
                null=0.0,
                apply=changes.dead_zone,
                describe=f"{who} acts smaller by a constant, and not where it is small",
            )
        )
    return found


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
        if bool((value != 0).any()):
            found += _of_input(name, before, value, delay, units.get(name, ""))
    return found


def _of_input(
    name: str, before: str, value: Tensor, delay: float, unit: str
) -> list[Effect]:
    called, who = before or "input ", f"the input {name}"

    def make(what: str, *, apply: Change, units: str = unit, **options: Any) -> Effect:
        on = OnInput(name, apply)
        return Effect(what, hook="input", apply=on, units=units, **options)

    known = value[value.isfinite()].double()[:, None]
    found = of_actuator(make, known, called, before, who)
    if not bool((value.diff(dim=1) != 0).any()):
        return found
    width = known.max(0).values - known.min(0).values
    for kind, change, how in (
        ("delay", delayed_input, "later"),
        ("lag", lagged_input, "behind a first-order lag"),
    ):
        found.append(
            make(
                f"{called}{kind}",
                prior=_half(torch.tensor([delay]).double()),
                null=0.0,
                apply=AlongInput(change),
                units="s",
                describe=f"{who} acts {how}",
            )
        )
    found.append(
        make(
            f"{before}backlash",
            prior=_half(SCALES.offset * width),
            null=0.0,
            apply=changes.backlash,
            describe=f"{who} acts after a play at each turn",
        )
    )
    return found


def of_samples(sd: Tensor, times: Tensor) -> list[Effect]:
    """Return effects of a sensor along its samples.

    Args:
        sd: Standard deviation of its noise, one or one a channel.
        times: Times of the samples, shape (k,) or (t, k), NaN for none.
    """
    delay = _half(torch.tensor([typical_delay(times)]).double())
    span = float(times.nan_to_num(-torch.inf).max() - times.nan_to_num(torch.inf).min())
    make = partial(Effect, hook="observation", null=0.0)
    late = [
        make(
            f"sensor {kind}",
            prior=delay,
            apply=AlongSamples(change),
            units="s",
            describe=f"the sensor reads {how}",
        )
        for kind, change, how in (
            ("delay", delayed_samples, "what was there before"),
            ("lag", lagged_samples, "behind a first-order lag"),
        )
    ]
    creep = make(
        "drift in time",
        prior=normal(SCALES.creep * sd / span),
        apply=changes.creep,
        units="1/s",
        describe="the sensor's bias grows along each recording",
    )
    quantum = make(
        "sensor quantum",
        prior=_half(SCALES.quantum * sd),
        apply=changes.quantize,
        describe="the sensor reads multiples of a step",
    )
    return [creep, *late, quantum]


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
        apply=OnChannel(channel, effect.apply),
        describe=f"{name}: {effect.describe}",
    )


def normal(sd: Tensor) -> Distribution:
    """Return a normal prior about zero, one entry a number."""
    # Zero where nothing is known of the noise yet; Pyro turns the check of it on.
    one = Normal(torch.zeros_like(sd), sd, validate_args=False)
    return Independent(one, 1, validate_args=False)


def _half(sd: Tensor) -> Distribution:
    return Independent(HalfNormal(sd), 1)
