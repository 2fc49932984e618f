"""What a real servo has and the model lacks: friction, in four forms.

Each vanishes at zero. Prior widths are those of a gearbox of plastic and metal: dry
friction of a tenth of the stall torque, and an efficiency of about 70 %.
"""

from __future__ import annotations

import torch
from torch.distributions import Distribution, HalfNormal, Independent

from sbi_active.criticism import Effect

__all__ = ["make_effects"]


def make_effects() -> list[Effect]:
    """Return the effects.

    Example:
        >>> [effect.name for effect in make_effects()]
        ['Coulomb', 'load-dependent', 'torque-dependent', 'viscous']
    """
    return [
        Effect.keyword(
            "Coulomb",
            "coulomb",
            prior=_half_normal(0.07),
            units="N m",
            describe="dry friction of constant size",
        ),
        Effect.keyword(
            "load-dependent",
            "load",
            prior=_half_normal(0.3),
            describe="dry friction that is a share of the gravity load",
        ),
        Effect.keyword(
            "torque-dependent",
            "torque",
            prior=_half_normal(0.3),
            describe="dry friction that is a share of the motor's torque; none while "
            "the motor is off",
        ),
        Effect.keyword(
            "viscous",
            "viscous",
            prior=_half_normal(0.02),
            units="N m s/rad",
            describe="friction in proportion to the speed; while the motor is on, the "
            "same as more back-EMF",
        ),
    ]


def _half_normal(sd: float) -> Distribution:
    return Independent(HalfNormal(torch.full((1,), sd)), 1)
