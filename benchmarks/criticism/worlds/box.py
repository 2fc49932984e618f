"""World D: the box collision in MuJoCo, on a table that the scene does not describe.

Hidden is one of restitution, tilt, aim and camera bias, in turn. Declared are these and
five others that the task offers and that come near them: a force and a viscosity beside
the tilt, a gain of the speed beside the restitution, a center of mass beside the aim,
a time stamp beside the camera's bias. The scene is rough: a rocking cube makes x jump
by millimeters. Trials that end off the table have no outcome.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from benchmarks.criticism.worlds.world import World, noise_inflation
from sbi_active import DiscreteActions, SimulatorModel
from sbi_active.criticism import Effect

#: m/s, at which the pusher reaches the cube and seldom throws it off the table.
SPEEDS = (2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0)
HIDDEN = ("restitution", "tilt", "aim", "camera bias")
BESIDE = ("viscosity", "speed gain", "center of mass", "force", "time stamp")
DECLARED = (*HIDDEN, *BESIDE)


def library() -> list[Effect]:
    """Return the declared effects of the task."""
    from sbi_active.tasks.box_collision import make_effects

    found = {effect.name: effect for effect in make_effects()}
    return [found[name] for name in DECLARED]


def make_world() -> World:
    """Return world D.

    Raises:
        ImportError: If MuJoCo is not installed.
    """
    from sbi_active.tasks.box_collision import BoxCollisionTask

    task: Any = BoxCollisionTask()
    simulator = task.simulator
    assert simulator.setup is not None
    model = SimulatorModel(
        partial(simulator.fn, context=simulator.setup()),
        noise=simulator.noise,
        parameter_names=simulator.parameter_names,
        channel_names=simulator.channel_names,
    )
    return World(
        name="D",
        model=model,
        prior=task.prior,
        actions=DiscreteActions(SPEEDS, names=["speed"], units=["m/s"]),
        noise_sd=task.noise,
        library=library,
        scatter=noise_inflation(2.0),
        outside=[],
        hidden=HIDDEN,
        is_rough=True,
    )
