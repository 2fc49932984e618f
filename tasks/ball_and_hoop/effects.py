"""What a motor bench may have and a linear motor of first order lacks.

Each vanishes at its null. While the hoop turns one way only, Coulomb friction is an
offset of the input, the asymmetries are gains, and records say nothing between them.
"""

from __future__ import annotations

from sbi_active.criticism import Effect
from sbi_active.tasks.machines import keyword_effects

__all__ = ["make_effects"]

TABLE = """
Coulomb | coulomb | friction | V/s | 2
    dry friction of constant size
stiction | stribeck | friction | V/s | 1
    more dry friction at low speed
quadratic drag | quadratic | friction | 1/(V s) | 0.1
    friction in proportion to the speed squared
cubic drag | cubic | friction | 1/(V^2 s) | 0.01
    friction in proportion to the speed cubed
warm-up | warm_up | friction | | +-0.2
    friction changes while the motor warms
dead zone | dead_zone | amplifier | V | 0.05
    the amplifier acts on a command less a constant
compression | compression | amplifier | 1/V | 1
    the amplifier's gain falls with the command
input asymmetry | asymmetry | amplifier | | +-0.1
    the amplifier drives one way harder than the other
input delay | delay | amplifier | s | 0.2
    commands act late
motor lag | motor_lag | amplifier | s | 0.3
    the torque rises slowly
sensor lag | sensor_lag | sensor | s | 0.2
    the tachometer reads late
sensor offset | sensor_offset | sensor | V | +-0.2
    the tachometer reads a constant too much
sensor asymmetry | sensor_asymmetry | sensor | | +-0.05
    the tachometer reads more one way than the other
crosstalk | crosstalk | sensor | V/V | +-1
    the motor's current shows in the reading
"""


def make_effects() -> list[Effect]:
    """Return the effects.

    Example:
        >>> [effect.name for effect in make_effects()][:3]
        ['Coulomb', 'stiction', 'quadratic drag']
    """
    return keyword_effects(TABLE)
