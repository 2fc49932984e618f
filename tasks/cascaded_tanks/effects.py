"""What two tanks and a pump may have and Torricelli's law lacks.

Each vanishes at its null. The further outflow may have either sign: a real outlet lets
out more or less than Torricelli's law as the level grows, and an exponent other than
1/2 is nearly the same.
"""

from __future__ import annotations

import torch
from torch.distributions import Independent, Normal

from sbi_active.criticism import Effect
from sbi_active.tasks.machines import keyword_effects

__all__ = ["make_effects", "start_levels"]

#: Of the upper level around what the slope tells, and of the lower one around the first
#: reading, V.
START_SD = (1.0, 0.1)
TABLE = """
overflow | overflow | tanks | of the height above a rim | 0.5
    the upper tank runs over into the lower one, and that into the sink
linear outflow | upper_linear lower_linear | outlets | | +-0.3
    outflows of both tanks are partly in proportion to their levels
outflow exponent | exponent | outlets | | +-0.1
    outflows grow with another power of the level than 1/2
leak | leak | tanks | 1/s | 0.005
    the upper tank loses water in proportion to its level
constant loss | loss | tanks | V/s | 0.005
    the lower tank loses water at a constant rate
pump curve | pump_curve | pump | 1/V | +-0.05
    the pump's flow is no straight line of the voltage
pump lag | pump_lag | pump | s | 10
    the pump's flow follows slowly
pump dead zone | pump_dead_zone | pump | V | 0.2
    the pump does nothing below a voltage
pump fade | pump_fade | pump | | +-0.1
    the pump weakens along the record
sensor lag | sensor_lag | sensor | s | 8
    the sensor reads late
sensor offset | sensor_offset | sensor | V | +-0.1
    the sensor reads a constant too much
sensor curve | sensor_curve | sensor | V | +-0.2
    the sensor's reading is no straight line of the level
sensor saturation | sensor_saturation | sensor | | 0.5
    levels above 10 V read less than they are
"""


def make_effects() -> list[Effect]:
    """Return the effects.

    Example:
        >>> [effect.name for effect in make_effects()][:3]
        ['overflow', 'linear outflow', 'outflow exponent']
    """
    return keyword_effects(TABLE)


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
        describe="levels at the start, beside what the first readings tell",
    )
