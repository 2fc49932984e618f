"""Effects of sensors, by channel."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from sbi_active.criticism.effects.effect import Context, Effect
from sbi_active.criticism.effects.generic_series import of_samples, on_channel
from sbi_active.mujoco.effects.acting import normal
from sbi_active.mujoco.effects.nominal import Nominal
from sbi_active.mujoco.simulator import Channel

__all__ = ["of_sensors"]

#: Bias in deviations of what is read, relative error of the gain, and the quantum's
#: deviation in those of the sensor's noise where it is known, or of what is read.
BIAS, GAIN, NOISE = 0.05, 0.05, 0.01


def of_sensors(
    channels: tuple[Channel, ...], sizes: Nominal, sds: Tensor | None
) -> Iterator[Effect]:
    """Yield the effects of each channel.

    Args:
        channels: Channels of x.
        sizes: Sizes of the model.
        sds: Standard deviations of the noise, one or one a channel; None if they are
            not known.
    """
    times = torch.as_tensor(sizes.times)
    for k, channel in enumerate(channels):
        reading = float(sizes.reading[k])
        sd = NOISE * reading if sds is None else float(sds.reshape(-1)[k % sds.numel()])
        effects = [
            Effect(
                "bias",
                hook="observation",
                prior=normal(BIAS * reading),
                null=0.0,
                apply=_affine_bias,
                units=channel.unit,
                describe="the sensor reads too much by a constant",
            ),
            Effect(
                "gain",
                hook="observation",
                prior=normal(GAIN),
                null=0.0,
                apply=_affine_gain,
                describe="the sensor reads a multiple",
            ),
            *[
                replace(
                    e,
                    name=e.name.removeprefix("sensor "),
                    units=e.units or channel.unit,
                )
                for e in of_samples(torch.tensor([sd], dtype=torch.float64), times)
                if e.name.startswith("sensor ")
            ],
        ]
        for effect in effects:
            name = f"{channel.name} sensor"
            own = (
                on_channel(effect, k, name)
                if len(channels) > 1
                else replace(
                    effect,
                    name=f"{name} {effect.name}",
                    describe=f"{name}: {effect.describe}",
                )
            )
            yield replace(own, family="sensor")


@dataclass(frozen=True)
class _Affine:
    """Shifts or multiplies what a sensor reads."""

    is_gain: bool

    def __call__(self, x: Tensor, phi: Tensor, action: Tensor, context: Context) -> Any:
        own = phi.reshape(len(phi), *[1] * (x.ndim - 1))
        return x * (1 + own) if self.is_gain else x + own


_affine_bias, _affine_gain = _Affine(False), _Affine(True)
