"""World B: a block on two friction zones, seen six times by a camera.

The block of :mod:`~benchmarks.criticism.worlds.block` is pushed at a signed speed
between 1 and 3 m/s; the camera has an error of 5 mm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import torch
from sbi.utils import BoxUniform
from torch import Tensor

from benchmarks.criticism.worlds.block import slide
from benchmarks.criticism.worlds.world import (
    World,
    effect,
    half_normal,
    noise_inflation,
    normal,
    shifted,
    signed_uniform,
    stretched,
    uniform,
)
from sbi_active import DiscreteActions, GaussianNoise, SimulatorModel
from sbi_active.criticism import Effect

NOISE_SD = 0.005  # m
TIMES = (0.1, 0.25, 0.5, 0.8, 1.2, 2.0)  # s
SPEEDS = (1.0, 1.5, 2.0, 2.5, 3.0)  # m/s
ALIASES = {"stribeck": frozenset({"speed gain", "speed offset"})}


def library(scale: float = 1.0) -> list[Effect]:
    """Return the declared effects, the scales of their priors multiplied."""
    return [
        Effect.keyword("quadratic drag", prior=half_normal(0.2 * scale), units="1/m"),
        Effect.keyword("viscous drag", prior=half_normal(0.4 * scale), units="1/s"),
        Effect.keyword("tilt", prior=normal(math.radians(2.0) * scale), units="rad"),
        effect("speed gain", "action", normal(0.08 * scale), stretched),
        effect("speed offset", "action", normal(0.1 * scale), shifted, units="m/s"),
        effect("camera bias", "observation", normal(0.02 * scale), shifted, units="m"),
        effect("camera scale", "observation", normal(0.05 * scale), stretched),
        Effect.keyword(
            "time offset", prior=normal(0.03 * scale), units="s", family="observation"
        ),
    ]


def outside() -> list[Effect]:
    """Return the effects that the library lacks."""
    return [
        Effect.keyword("stribeck", prior=uniform(0.3, 0.8)),
        Effect.keyword("magnet", prior=signed_uniform(0.4, 1.2), units="m/s^2"),
        Effect.keyword("edge shift", prior=uniform(-0.25, -0.1), units="m"),
        Effect.keyword("wall", prior=uniform(0.6, 1.2), units="m", null=torch.inf),
    ]


def bare_model(times: Sequence[float]) -> partial[Tensor]:
    """Return the block seen at some times."""
    return partial(slide, times=times)


def make_world(*, one_way: bool = False) -> World:
    """Return world B.

    Args:
        one_way: Permit pushes in the positive direction only. A tilt is then a change
            of both frictions, and nothing shows it.
    """
    speeds = SPEEDS if one_way else (*(-v for v in reversed(SPEEDS)), *SPEEDS)
    return World(
        name="B",
        model=SimulatorModel(
            bare_model(TIMES),
            noise=GaussianNoise(NOISE_SD),
            parameter_names=["friction_near", "friction_far"],
            channel_names=[f"x({t:g} s)" for t in TIMES],
        ),
        prior=BoxUniform(0.1 * torch.ones(2), 0.5 * torch.ones(2)),
        actions=DiscreteActions(speeds, names=["speed"], units=["m/s"]),
        noise_sd=NOISE_SD,
        library=library,
        scatter=noise_inflation(2.0),
        outside=outside(),
        equivalences=[frozenset({"none", "tilt"})] if one_way else [],
        aliases=ALIASES,
        formulas={"camera bias": frozenset({"1"}), "camera scale": frozenset({"x"})},
    )
