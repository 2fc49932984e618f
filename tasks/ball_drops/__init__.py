"""Balls dropped from a bridge: measured falls, and a simulator with gravity alone."""

from sbi_active.tasks.ball_drops.data import Drop, read_drops, trials_of
from sbi_active.tasks.ball_drops.effects import DRAG, make_effects, release
from sbi_active.tasks.ball_drops.model import fall, make_prior, make_simulator
from sbi_active.tasks.ball_drops.task import BallDropsTask

__all__ = [
    "DRAG",
    "BallDropsTask",
    "Drop",
    "fall",
    "make_effects",
    "make_prior",
    "make_simulator",
    "read_drops",
    "release",
    "trials_of",
]
