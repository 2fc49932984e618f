"""What a real servo has and the model lacks: friction, in four forms.

Each vanishes at zero. Prior widths are those of a gearbox of plastic and metal: dry
friction of a tenth of the stall torque, and an efficiency of about 70 %.
"""

from __future__ import annotations

from sbi_active.criticism import Effect
from sbi_active.tasks.machines import keyword_effects

__all__ = ["make_effects"]

TABLE = """
Coulomb | coulomb | friction | N m | 0.07
    dry friction of constant size
load-dependent | load | friction | | 0.3
    dry friction that is a share of the gravity load
torque-dependent | torque | friction | | 0.3
    dry friction that is a share of the motor's torque; none while the motor is off
viscous | viscous | friction | N m s/rad | 0.02
    friction in proportion to the speed; while the motor is on, \
the same as more back-EMF
"""


def make_effects() -> list[Effect]:
    """Return the effects.

    Example:
        >>> [effect.name for effect in make_effects()]
        ['Coulomb', 'load-dependent', 'torque-dependent', 'viscous']
    """
    return keyword_effects(TABLE)
