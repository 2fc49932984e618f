"""What a real servo has and the model lacks: friction, in four forms.

Each vanishes at zero. Prior widths are those of a gearbox of plastic and metal: dry
friction of a tenth of the stall torque, and an efficiency of about 70 %.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.distributions import HalfNormal, Independent

from sbi_active.criticism import Effect
from sbi_active.criticism.effects import Context

__all__ = ["make_effects"]


def make_effects() -> list[Effect]:
    """Return the effects.

    Example:
        >>> [effect.name for effect in make_effects()]
        ['Coulomb', 'load-dependent', 'torque-dependent', 'viscous']
    """
    return [
        _friction(
            "Coulomb",
            "coulomb",
            0.07,
            units="N m",
            describe="dry friction of constant size",
        ),
        _friction(
            "load-dependent",
            "load",
            0.3,
            describe="dry friction that is a share of the gravity load",
        ),
        _friction(
            "torque-dependent",
            "torque",
            0.3,
            describe="dry friction that is a share of the motor's torque; none while "
            "the motor is off",
        ),
        _friction(
            "viscous",
            "viscous",
            0.02,
            units="N m s/rad",
            describe="friction in proportion to the speed; while the motor is on, the "
            "same as more back-EMF",
        ),
    ]


def _friction(
    name: str, keyword: str, sd: float, *, describe: str, units: str = ""
) -> Effect:
    def apply(
        value: dict[str, Any], phi: Tensor, action: Tensor, context: Context
    ) -> dict[str, Any]:
        return {**value, keyword: phi[:, 0]}

    return Effect(
        name,
        hook="dynamics",
        prior=Independent(HalfNormal(torch.full((1,), sd)), 1),
        null=0.0,
        apply=apply,
        units=units,
        describe=describe,
    )
