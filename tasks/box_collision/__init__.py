"""A cube pushed by another on a table: three parameters, one action, a position."""

from sbi_active.tasks.box_collision.effects import make_effects
from sbi_active.tasks.box_collision.reference import (
    BoxCollisionReference,
    exact_posterior,
)
from sbi_active.tasks.box_collision.render import render
from sbi_active.tasks.box_collision.task import BoxCollisionTask

__all__ = [
    "BoxCollisionReference",
    "BoxCollisionTask",
    "exact_posterior",
    "make_effects",
    "render",
]
