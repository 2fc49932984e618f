"""What a fall may have and gravity alone lacks.

The three drags are one idea with an exponent of 1, of 2, and unknown; they share the
prior probability of their family. Buoyancy and the rate of the frames shorten the way
by a constant factor, as the picture's scale does, and no fall tells these apart.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution, HalfNormal, Independent, Normal, Uniform

from sbi_active.criticism import Effect
from sbi_active.tasks.ball_drops.model import RELEASE_HEIGHT
from sbi_active.tasks.product import Product

__all__ = ["DRAG", "make_effects", "release", "wind"]

#: Family of everything that slows the ball with its speed.
DRAG = "drag"
DRAG_SD = 3.0  # m/s^2 at 10 m/s, a third of the weight
EXPONENT = (0.5, 2.5)
#: Most of the weight that air carries: 1.7 % of a basketball, the largest.
BUOYANCY = 0.02
WIND = 1.0  # m/s, up or down, of a light breeze around a bridge
RATE = 0.02  # largest relative error of the frame rate


def make_effects() -> list[Effect]:
    """Return the nuisances of each drop and the effects.

    Example:
        >>> [effect.name for effect in make_effects()][:3]
        ['release', 'wind', 'linear drag']
    """
    half = HalfNormal(torch.tensor([DRAG_SD]))
    low, high = (torch.tensor([end]) for end in EXPONENT)
    exponent = Uniform(low, high)
    return [
        release(),
        wind(),
        Effect(
            "linear drag",
            hook="dynamics",
            prior=Independent(half, 1),
            null=0.0,
            apply=lambda value, phi, action, context: _drag(value, phi[:, 0], 1.0),
            units="m/s^2 at 10 m/s",
            family=DRAG,
            describe="air slows the ball in proportion to its speed",
        ),
        Effect(
            "quadratic drag",
            hook="dynamics",
            prior=Independent(half, 1),
            null=0.0,
            apply=lambda value, phi, action, context: _drag(value, phi[:, 0], 2.0),
            units="m/s^2 at 10 m/s",
            family=DRAG,
            describe="air slows the ball in proportion to its speed squared",
        ),
        Effect.keyword(
            "power-law drag",
            *("drag", "exponent"),
            prior=Product([half, exponent]),
            null=torch.tensor([0.0, 1.0]),
            units="m/s^2 at 10 m/s, exponent",
            family=DRAG,
            describe="air slows the ball in proportion to some power of its speed",
        ),
        Effect.keyword(
            "buoyancy",
            "lightness",
            prior=_between(0.0, BUOYANCY),
            units="of the weight",
            family="medium",
            describe="air carries a part of the weight",
        ),
        Effect.keyword(
            "frame rate",
            "clock",
            prior=_between(-RATE, RATE),
            units="relative",
            family="camera",
            describe="the rate of the frames is wrong by a factor",
        ),
    ]


def release() -> Effect:
    """Return where and when a drop begins, anew in each."""
    middle = torch.tensor([RELEASE_HEIGHT, 0.0])
    return Effect.keyword(
        "release",
        *("height", "start"),
        prior=Independent(Normal(middle, torch.tensor([2.0, 0.2])), 1),
        null=middle,
        units="m, s",
        scope="trial",
        describe="height and time at which the ball is let go",
    )


def wind() -> Effect:
    """Return how fast the air rises below the bridge, anew in each drop."""
    return Effect.keyword(
        "wind",
        prior=Independent(Normal(torch.zeros(1), torch.tensor([WIND])), 1),
        units="m/s",
        scope="trial",
        describe="the air rises or sinks while the ball falls",
    )


def _between(low: float, high: float) -> Distribution:
    return Independent(Uniform(torch.tensor([low]), torch.tensor([high])), 1)


def _drag(
    value: dict[str, Any], drag: Tensor, exponent: Tensor | float
) -> dict[str, Any]:
    return {**value, "drag": drag, "exponent": exponent}
