"""Names under which effects are counted: equivalent ones as one."""

from __future__ import annotations

from collections.abc import Mapping

from benchmarks.criticism.worlds import World


def true_name(world: World, effects: str) -> str:
    """Return the name that the loop should give a single truth."""
    if effects == world.scatter.name:
        return "scatter"
    return "none" if effects in world.equivalent("none") else effects


def merged(world: World, probabilities: Mapping[str, float]) -> dict[str, float]:
    """Return probabilities, most likely first, equivalent effects counted as one."""
    total: dict[str, float] = {}
    for name, probability in probabilities.items():
        key = min(world.equivalent(name)) if name != "none" else "none"
        key = "none" if name in world.equivalent("none") else key
        total[key] = total.get(key, 0.0) + probability
    return dict(sorted(total.items(), key=lambda item: -item[1]))
