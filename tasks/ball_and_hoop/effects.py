"""What a motor bench may have and a linear motor of first order lacks.

Each vanishes at its null. While the hoop turns one way only, Coulomb friction is an
offset of the input, the asymmetries are gains, and records say nothing between them.
"""

from __future__ import annotations

import torch
from torch.distributions import Distribution, HalfNormal, Independent, Normal

from sbi_active.criticism import Effect

__all__ = ["make_effects"]

#: Keyword, name, family, unit, prior deviation (negative for either sign), sentence.
TABLE = (
    ("coulomb", "Coulomb", "friction", "V/s", 2.0, "dry friction of constant size"),
    (
        "stribeck",
        "stiction",
        "friction",
        "V/s",
        1.0,
        "more dry friction at low speed",
    ),
    (
        "quadratic",
        "quadratic drag",
        "friction",
        "1/(V s)",
        0.1,
        "friction in proportion to the speed squared",
    ),
    (
        "cubic",
        "cubic drag",
        "friction",
        "1/(V^2 s)",
        0.01,
        "friction in proportion to the speed cubed",
    ),
    (
        "warm_up",
        "warm-up",
        "friction",
        "",
        -0.2,
        "friction changes while the motor warms",
    ),
    (
        "dead_zone",
        "dead zone",
        "amplifier",
        "V",
        0.05,
        "the amplifier acts on a command less a constant",
    ),
    (
        "compression",
        "compression",
        "amplifier",
        "1/V",
        1.0,
        "the amplifier's gain falls with the command",
    ),
    (
        "asymmetry",
        "input asymmetry",
        "amplifier",
        "",
        -0.1,
        "the amplifier drives one way harder than the other",
    ),
    ("delay", "input delay", "amplifier", "s", 0.2, "commands act late"),
    ("motor_lag", "motor lag", "amplifier", "s", 0.3, "the torque rises slowly"),
    ("sensor_lag", "sensor lag", "sensor", "s", 0.2, "the tachometer reads late"),
    (
        "sensor_offset",
        "sensor offset",
        "sensor",
        "V",
        -0.2,
        "the tachometer reads a constant too much",
    ),
    (
        "sensor_asymmetry",
        "sensor asymmetry",
        "sensor",
        "",
        -0.05,
        "the tachometer reads more one way than the other",
    ),
    (
        "crosstalk",
        "crosstalk",
        "sensor",
        "V/V",
        -1.0,
        "the motor's current shows in the reading",
    ),
)


def make_effects() -> list[Effect]:
    """Return the effects.

    Example:
        >>> [effect.name for effect in make_effects()][:3]
        ['Coulomb', 'stiction', 'quadratic drag']
    """
    return [
        Effect.keyword(
            name,
            keyword,
            prior=_prior(sd),
            units=units,
            family=family,
            describe=describe,
        )
        for keyword, name, family, units, sd, describe in TABLE
    ]


def _prior(sd: float) -> Distribution:
    scale = torch.tensor([abs(sd)])
    if sd > 0:
        return Independent(HalfNormal(scale), 1)
    return Independent(Normal(torch.zeros(1), scale), 1)
