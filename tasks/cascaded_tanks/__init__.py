"""Two tanks in series: recorded pump voltages and levels of real ones."""

from sbi_active.tasks.cascaded_tanks.effects import make_effects, start_levels
from sbi_active.tasks.cascaded_tanks.model import levels, make_prior, make_simulator
from sbi_active.tasks.cascaded_tanks.recordings import (
    DATA,
    FOUND_ON,
    read_recordings,
    split,
)

__all__ = [
    "DATA",
    "FOUND_ON",
    "levels",
    "make_effects",
    "make_prior",
    "make_simulator",
    "read_recordings",
    "split",
    "start_levels",
]
