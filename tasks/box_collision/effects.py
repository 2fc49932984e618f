r"""What a real table may have and the scene lacks.

Each effect vanishes exactly at its null. ``describe`` quotes the shift that it makes of
the cube's x at 3, 5 and 7 m/s, for theta = (.2, .2, .2) on a table without end.

A central push shows only x. A gain and an offset of the speed then differ by how they
grow with the speed alone, and so do a tilt and a force; a shift of the pusher's aim or
of the center of mass shows in y.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.distributions import Beta, Independent

from sbi_active.criticism import Context, Effect
from sbi_active.tasks.machines import half_normal, normal

__all__ = ["make_effects"]

CODED = -0.5  # m; z below it stands for an outcome off the table, not for a position


def make_effects() -> list[Effect]:
    """Return the effects, with priors of the width that a laboratory may expect.

    Example:
        >>> [effect.name for effect in make_effects()][:2]
        ['restitution', 'viscosity']
    """
    return [
        Effect.keyword(
            "restitution",
            "lost_damping",
            prior=Independent(Beta(torch.ones(1), 2 * torch.ones(1)), 1),
            units="",
            family="impact",
            describe="The impact is springy: its damping ratio is 1 - phi. "
            "At 0.7: +318/+681/+1008 mm.",
        ),
        Effect.keyword(
            "viscosity",
            "viscosity",
            prior=half_normal(0.3),
            units="Pa s",
            family="medium",
            describe="The medium drags in proportion to the speed. "
            "At 0.5 Pa s: -402/-996/-1425 mm.",
        ),
        Effect.keyword(
            "air",
            "air_density",
            prior=half_normal(1.2),
            units="kg/m^3",
            family="medium",
            describe="The medium drags with the square of the speed. "
            "At 1.2 kg/m^3: -19/-72/-143 mm.",
        ),
        Effect.keyword(
            "tilt",
            "tilt",
            prior=normal(1.0),
            units="deg",
            family="table",
            describe="The table slopes down ahead by phi. At 1 deg: +85/+86/+85 mm.",
        ),
        Effect(
            "speed gain",
            hook="action",
            prior=normal(0.05),
            null=0.0,
            apply=lambda speed, phi, action, context: speed * (1 + phi),
            family="speed",
            describe="The pusher's speed is 1 + phi times the commanded. "
            "At -0.05: -145/-160/-177 mm.",
        ),
        Effect(
            "speed offset",
            hook="action",
            prior=normal(0.1),
            null=0.0,
            apply=lambda speed, phi, action, context: speed + phi,
            units="m/s",
            family="speed",
            describe="The pusher is faster than commanded by phi. "
            "At 0.1 m/s: +21/+132/+53 mm.",
        ),
        Effect.keyword(
            "aim",
            "aim",
            prior=normal(0.01),
            units="m",
            family="alignment",
            describe="The pusher's path is shifted by phi along y. "
            "At 0.01 m: -51/-135/-208 mm in y.",
        ),
        Effect.keyword(
            "center of mass",
            "center_of_mass",
            prior=normal(0.01),
            units="m",
            family="alignment",
            describe="The cube's center of mass is off by phi along y. "
            "At 0.01 m: +50/+140/+223 mm in y.",
        ),
        Effect.keyword(
            "pusher friction",
            "extra_pusher_friction",
            prior=normal(0.15),
            units="",
            family="pusher",
            describe="The pusher's surface has friction .5 + phi. "
            "At 0.3: -71/-97/-56 mm.",
        ),
        Effect.keyword(
            "force",
            "force",
            prior=normal(0.3),
            units="N",
            family="force",
            describe="A constant force, of a cable, pulls the cube ahead. "
            "At 0.3 N: +184/+196/+194 mm.",
        ),
        Effect(
            "camera bias",
            hook="observation",
            prior=normal(0.01),
            null=0.0,
            apply=_shift,
            units="m",
            describe="The camera reads x too large by phi. At 0.01 m: +10/+10/+10 mm.",
        ),
        Effect(
            "camera scale",
            hook="observation",
            prior=normal(0.02),
            null=0.0,
            apply=_stretch,
            describe="The camera reads x and y times 1 + phi. At 0.02: +19/+47/+72 mm.",
        ),
        Effect.keyword(
            "time stamp",
            "delay",
            prior=normal(0.03),
            units="s",
            family="observation",
            describe="The position is taken late by phi. At 0.05 s: +5/+76/+137 mm.",
        ),
    ]


def _shift(x: Tensor, phi: Tensor, action: Tensor, context: Context) -> Tensor:
    return torch.where(x[:, 2:] < CODED, x, x + _columns(phi, 1, 0, 0))


def _stretch(x: Tensor, phi: Tensor, action: Tensor, context: Context) -> Tensor:
    return torch.where(x[:, 2:] < CODED, x, x * (1 + _columns(phi, 1, 1, 0)))


def _columns(phi: Tensor, *shares: float) -> Tensor:
    """Return phi (n, 1) spread over the coordinates, shape (n, 3)."""
    return phi * torch.tensor(shares, dtype=phi.dtype)
