"""Worlds of the closed loop on images: what is poured, where, and with which effects.

    python -m benchmarks pouring.loop.worlds FOLDER --part cubes --rows 900
    python -m benchmarks pouring.loop.worlds FOLDER --part material --rows 600
    python -m benchmarks pouring.loop.worlds FOLDER --part cubes --report

Rows are pours at a world's few actions with parameters from the prior and with effects:
each is absent from half of the rows, and else up to two and a half times as strong as
its prior says, since the loop tries priors of three times the width. Effects of the
camera are not poured: images know them. Files are those of ``benchmarks.pouring.bank``.
"material" is learned from the pours that compare materials besides, part ``compared``
of ``benchmarks.pouring.material.bank``, which have no effect.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.pouring.bank import ROWS_A_FILE, Drawn, Filling, run_filling
from sbi_active.criticism import Effect
from sbi_active.seeding import derive_seed, forked_generators, row_seeds
from sbi_active.tasks import get_task

WIDTHS, WIDTH_SHARES = (0.0, 1.0, 2.5), (0.5, 0.3, 0.2)


@dataclass(frozen=True)
class World:
    """What the loop is tried on.

    Attributes:
        name: "cubes" or "material".
        task: Gives the model, its prior and its effects.
        actions: Of the trials, shape (a, 3).
    """

    name: str
    task: Any
    actions: Tensor


def get_world(name: str) -> World:
    """Return a world by name."""
    task, actions = WORLDS[name]
    return World(name, get_task(task), torch.tensor(actions, dtype=torch.float32))


#: The task, and the actions of the trials.
WORLDS = {
    "cubes": ("pouring", [[20, 0, 2], [20, -30, 5], [140, 0, 2]]),
    "material": ("pouring_real", [[15, 0, 0.9], [35, 0, 0.9], [55, 0, 1.6]]),
}


def poured_effects(world: World) -> list[Effect]:
    """Return the effects that a pour has, not the camera."""
    return [e for e in world.task.effects() if e.hook == "dynamics"]


def phi_of(world: World, num: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return strengths by keyword, each of shape (n,)."""
    found = {}
    for effect in poured_effects(world):
        width = rng.choice(WIDTHS, num, p=WIDTH_SHARES)
        found[effect.apply.names[0]] = width * effect.sample(num)[:, 0].numpy()  # type: ignore[attr-defined]
    return found


def draw(world: World, part: str, number: int) -> Drawn:
    """Return what a file of rows is poured with."""
    seed = derive_seed(0, "loop bank", part, number)
    with forked_generators(seed):
        theta = world.task.prior.sample(torch.Size([ROWS_A_FILE]))
        effects = phi_of(world, ROWS_A_FILE, np.random.default_rng(seed))
    place = (torch.arange(ROWS_A_FILE) + ROWS_A_FILE * number) % len(world.actions)
    return Drawn(theta, world.actions[place], row_seeds(seed, ROWS_A_FILE), effects)


@dataclass(frozen=True)
class WorldFilling(Filling):
    """What is poured with effects, in one of the worlds."""

    part: Annotated[str, WORLDS] = next(iter(WORLDS))
    rows: int = 350


def main(filling: WorldFilling) -> None:
    """Pour with effects."""
    world = get_world(filling.part)
    run_filling(filling, world.task.pours, partial(draw, world))
