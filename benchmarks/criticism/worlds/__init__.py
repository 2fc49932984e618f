"""Worlds whose truth is known."""

from typing import Any

from benchmarks.criticism.worlds import box, numerical, sliding_block
from benchmarks.criticism.worlds.world import World

__all__ = ["World", "get_world"]

WORLDS = {
    "A": numerical.make_world,
    "B": sliding_block.make_world,
    "C": sliding_block.make_trajectories,
    "D": box.make_world,
}


def get_world(name: str, **options: Any) -> World:
    """Return a world by its letter.

    Args:
        name: "A" the numerical model, "B" the sliding block, "C" its trajectories,
            "D" the box collision.
        options: Of the world, see its ``make_world``.
    """
    if name not in WORLDS:
        raise ValueError(f"expected a world among {[*WORLDS]}; got {name!r}; choose")
    return WORLDS[name](**options)
