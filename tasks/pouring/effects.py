"""What a real pour may have and the model lacks; each vanishes exactly at its null."""

from __future__ import annotations

import torch
from torch import Tensor

from sbi_active.criticism import Context, Effect
from sbi_active.tasks.machines import half_normal, normal
from sbi_active.tasks.pouring.raster import NUM_PIXELS, PIXEL

__all__ = ["make_effects"]


def make_effects() -> list[Effect]:
    """Return the effects, with priors of the width that a laboratory may expect.

    Example:
        >>> [effect.name for effect in make_effects()][:2]
        ['linear damping', 'angular damping']
    """
    dynamics = [
        ("linear damping", "linear_damping", half_normal(0.5), "1/s", "medium"),
        ("angular damping", "angular_damping", half_normal(0.5), "1/s", "medium"),
        ("tilt", "tilt", normal(1.0), "deg", "ground"),
        ("bucket position", "bucket_y", normal(0.01), "m", "bucket"),
        ("bucket height", "bucket_height", normal(0.01), "m", "bucket"),
        ("cohesion", "cohesion", half_normal(0.5), "", "particles"),
        ("lag", "lag", half_normal(0.1), "s", "bucket"),
    ]
    effects = [
        Effect.keyword(name, keyword, prior=prior, units=units, family=family)
        for name, keyword, prior, units, family in dynamics
    ]
    return [
        *effects,
        Effect(
            "camera offset",
            hook="observation",
            prior=normal(0.006),
            null=0.0,
            apply=_shift,
            units="m",
            family="camera",
            describe="The picture is shifted by phi along y.",
        ),
        Effect(
            "camera gain",
            hook="observation",
            prior=normal(0.05),
            null=0.0,
            apply=lambda x, phi, action, context: x * (1 + phi),
            family="camera",
            describe="Heights read 1 + phi times as large.",
        ),
    ]


def _shift(x: Tensor, phi: Tensor, action: Tensor, context: Context) -> Tensor:
    """Shift images along y, between pixels by linear interpolation."""
    pictures = x.reshape(-1, NUM_PIXELS, NUM_PIXELS)
    place = torch.arange(NUM_PIXELS) - phi.reshape(-1, 1).to(x) / PIXEL  # (n, pixels)
    low = place.floor()
    share = (place - low)[:, None]
    parts = []
    for k, weight in ((0, 1 - share), (1, share)):
        index = low.long() + k
        seen = ((index >= 0) & (index < NUM_PIXELS))[:, None]
        index = index.clamp(0, NUM_PIXELS - 1)[:, None].expand_as(pictures)
        zero = torch.zeros((), dtype=x.dtype)
        # Where the weight is zero nothing is read: a hole stays a single hole.
        read = torch.where(seen & (weight > 0), pictures.gather(2, index), zero)
        parts.append(read * weight)
    return (parts[0] + parts[1]).reshape(x.shape)
