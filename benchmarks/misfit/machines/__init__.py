"""Machines whose truth is known, with a library of effects each."""

from benchmarks.misfit.machines.letters import make_letter
from benchmarks.misfit.machines.machine import Machine
from benchmarks.misfit.machines.pendulum import make_pendulum
from benchmarks.misfit.machines.spring import make_spring
from benchmarks.misfit.machines.tanks import make_tanks

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
