"""Worlds whose truth is known."""

from benchmarks.criticism.worlds import box, numerical, sliding_block
from benchmarks.criticism.worlds.world import World

__all__ = ["WORLDS", "World", "get_world"]

WORLDS = {
    "A": numerical.make_world,
    "B": sliding_block.make_world,
    "C": sliding_block.make_trajectories,
    "D": box.make_world,
}


def get_world(name: str) -> World:
    """Return a world by its letter.

    Args:
        name: "A" the numerical model, "B" the sliding block, "C" its trajectories,
            "D" the box collision.
    """
    return WORLDS[name]()
