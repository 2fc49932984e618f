"""A motor bench with a heavy hoop: recorded voltages and speeds of a real one."""

from sbi_active.tasks.ball_and_hoop.effects import make_effects
from sbi_active.tasks.ball_and_hoop.model import make_prior, make_simulator, spin
from sbi_active.tasks.ball_and_hoop.recordings import DATA, read_recordings, split

__all__ = [
    "DATA",
    "make_effects",
    "make_prior",
    "make_simulator",
    "read_recordings",
    "spin",
    "split",
]
