"""Machines whose truth is known, with a library of effects each.

Worlds A, B and C of :mod:`benchmarks.criticism.worlds`, with what nobody declared.

A (one number a trial) and B (six) have no time axis that is declared; C has 50 samples
with independent errors. What wanders does so from trial to trial. Undeclared forms are
those that the worlds have outside of their libraries.
"""

from __future__ import annotations

import inspect
from typing import Any

import torch
from torch import Tensor

from benchmarks.criticism.worlds import get_world
from benchmarks.criticism.worlds.sliding_block import TIMES
from benchmarks.misfit.machines.joints import make_pendulum, make_spring
from benchmarks.misfit.machines.machine import Hidden, Machine
from benchmarks.misfit.machines.tanks import make_tanks

#: Where the undeclared forms vanish, and their names for tuning and judging seeds.
FORMS = {"A": (("sine", "bump"), ("step", "power"))}
FORMS |= dict.fromkeys("BC", (("magnet",), ("stribeck", "edge_shift")))
SPEED = {"A": ("action offset", "saturation"), "B": ("time offset", "speed offset")}
SLOW = {"A": ("drift", "quadratic"), "B": ("quadratic drag", "tilt")}


def make_letter(letter: str, num_trials: int) -> Machine:
    """Return a world as a machine.

    Args:
        letter: "A", "B" or "C".
        num_trials: To fit; twice as many in A, whose trials have one number each.
    """
    world = get_world(letter)
    bare = world.model.fn
    forms, unseen = FORMS[letter]

    def fn(
        theta: Tensor, action: Tensor, *, hidden: Hidden | None = None, **effects: Any
    ) -> Tensor:
        theta = theta.clone()
        for name, value in (hidden or {}).items():
            kind, _, what = name.partition(" ")
            if kind == "wander":
                theta[:, int(what)] *= 1 + value[:, 0].to(theta)
            else:
                effects[what] = value.to(theta) + effects.get(what, 0.0)
        return bare(theta, action, **effects)

    # A model knows its effects by the signature of its function; times are the world's.
    signature = inspect.signature(bare)
    keep = [p for name, p in signature.parameters.items() if name != "times"]
    fn.__signature__ = signature.replace(parameters=keep)  # type: ignore[attr-defined]
    kind = "A" if letter == "A" else "B"
    times = torch.tensor(TIMES) if letter == "B" else None
    times = torch.tensor(world.sample_times) if letter == "C" else times
    return Machine(
        name=letter,
        fn=fn,
        prior=world.prior,
        parameter_names=world.model.parameter_names or (),
        draw_actions=lambda num: world.actions.sample((num,)).double(),
        noise_sd=world.noise_sd,
        times=times,
        num_trials=2 * num_trials if letter == "A" else num_trials,
        library=world.effects,
        fast=SPEED[kind],
        slow=SLOW[kind],
        forms=forms,
        unseen_forms=unseen,
        unsigned_forms=("stribeck",),
        wandering=("wander 0", "wander 1"),
        takes_force=False,
        declares_times=letter == "C",
        equivalences=world.equivalences,
    )


__all__ = ["GROUPS", "LAYOUTS", "Machine", "get_machine"]

MAKERS = {"pendulum": make_pendulum, "spring": make_spring, "tanks": make_tanks}
#: Machines by the name of their group.
GROUPS = {"own": (*MAKERS,), "letters": ("A", "B", "C")}
#: Trials to fit, and samples of each.
LAYOUTS = ((10, 20), (6, 30))


def get_machine(name: str, layout: tuple[int, int] = LAYOUTS[0]) -> Machine:
    """Return a machine.

    Args:
        name: "pendulum", "spring", "tanks", or the letter of a world.
        layout: Trials to fit, and samples of each; a letter has its own samples.
    """
    if name in MAKERS:
        return MAKERS[name](*layout)
    if name in GROUPS["letters"]:
        return make_letter(name, layout[0])
    known = ", ".join(GROUPS["own"] + GROUPS["letters"])
    raise ValueError(f"expected a machine among {known}; got {name!r}; choose one")
