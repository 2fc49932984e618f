"""What two tanks and a pump may have and Torricelli's law lacks.

Each vanishes at its null. The further outflow may have either sign: a real outlet lets
out more or less than Torricelli's law as the level grows, and an exponent other than
1/2 is nearly the same.
"""

from __future__ import annotations

import torch
from torch.distributions import Distribution, HalfNormal, Independent, Normal

from sbi_active.criticism import Effect

__all__ = ["make_effects", "start_levels"]

#: Of the upper and the lower level around the first reading, V.
START_SD = (3.0, 0.1)
#: Keywords, name, family, unit, prior deviation (negative for either sign), sentence.
TABLE = (
    (
        ("overflow",),
        "overflow",
        "tanks",
        "1/s",
        0.2,
        "the upper tank runs over into the lower one, and that into the sink",
    ),
    (
        ("upper_linear", "lower_linear"),
        "linear outflow",
        "outlets",
        "1/s",
        -0.01,
        "further outflows of both tanks in proportion to their levels",
    ),
    (
        ("exponent",),
        "outflow exponent",
        "outlets",
        "",
        -0.1,
        "outflows grow with another power of the level than 1/2",
    ),
    (
        ("leak",),
        "leak",
        "tanks",
        "1/s",
        0.005,
        "the upper tank loses water in proportion to its level",
    ),
    (
        ("loss",),
        "constant loss",
        "tanks",
        "V/s",
        0.005,
        "the lower tank loses water at a constant rate",
    ),
    (
        ("pump_curve",),
        "pump curve",
        "pump",
        "1/V",
        -0.05,
        "the pump's flow is no straight line of the voltage",
    ),
    (("pump_lag",), "pump lag", "pump", "s", 10.0, "the pump's flow follows slowly"),
    (
        ("pump_dead_zone",),
        "pump dead zone",
        "pump",
        "V",
        0.2,
        "the pump does nothing below a voltage",
    ),
    (
        ("pump_fade",),
        "pump fade",
        "pump",
        "",
        -0.1,
        "the pump weakens along the record",
    ),
    (("sensor_lag",), "sensor lag", "sensor", "s", 8.0, "the sensor reads late"),
    (
        ("sensor_offset",),
        "sensor offset",
        "sensor",
        "V",
        -0.1,
        "the sensor reads a constant too much",
    ),
    (
        ("sensor_curve",),
        "sensor curve",
        "sensor",
        "V",
        -0.2,
        "the sensor's reading is no straight line of the level",
    ),
    (
        ("sensor_saturation",),
        "sensor saturation",
        "sensor",
        "",
        0.5,
        "levels above 10 V read less than they are",
    ),
)


def make_effects() -> list[Effect]:
    """Return the effects.

    Example:
        >>> [effect.name for effect in make_effects()][:3]
        ['overflow', 'linear outflow', 'outflow exponent']
    """
    return [
        Effect.keyword(
            name,
            *keywords,
            prior=_prior(sd, len(keywords)),
            units=units,
            family=family,
            describe=describe,
        )
        for keywords, name, family, units, sd, describe in TABLE
    ]


def start_levels() -> Effect:
    """Return the levels at the start of a trial, a nuisance of each."""
    sd = torch.tensor(START_SD)
    return Effect.keyword(
        "start levels",
        "upper_start",
        "lower_start",
        prior=Independent(Normal(torch.zeros(2), sd), 1),
        units="V",
        scope="trial",
        describe="levels of both tanks at the start, beside the first reading",
    )


def _prior(sd: float, num: int) -> Distribution:
    scale = torch.full((num,), abs(sd))
    if sd > 0:
        return Independent(HalfNormal(scale), 1)
    return Independent(Normal(torch.zeros(num), scale), 1)
