"""The library of effects that a plain model lacks, enumerated from the model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.augmented import AugmentedSimulator
from sbi_active.criticism.effects.effect import Context, Effect
from sbi_active.criticism.effects.table import picked
from sbi_active.expected import suggests
from sbi_active.mujoco.effects.changes import QuantityChange
from sbi_active.mujoco.effects.elements import elements
from sbi_active.mujoco.robot import Robot, from_spec
from sbi_active.mujoco.simulator import MujocoFunction
from sbi_active.mujoco.typical import nominal
from sbi_active.simulation import SimulatorModel


@suggests
def mjcf_effects(
    model: Any,
    *,
    trials: Trials | None = None,
    include: str | Sequence[str] = "*",
    exclude: str | Sequence[str] = (),
) -> list[Effect]:
    r"""Return effects that a plain model may lack, with names, units, nulls and priors.

    Each effect is named after its element, as in "hinge friction loss". Similar
    elements, such as the knees of four legs, are offered together, as in "all knee
    friction loss", and one by one. Priors are scaled by the forces that move the robot:
    a friction's deviation is a fifth of the generalized force along nominal
    trajectories. Effects that are parameters already, or that change nothing there, are
    left out.

    ============= ==================================================================
    of            effects
    ============= ==================================================================
    joints        friction loss, the same by position and by load, static friction,
                  viscous, quadratic and cubic damping, stiffness, quadratic and cubic
                  stiffness, armature, zero offset, backlash, series elasticity
    actuators     gain, bias, back-EMF, saturation; delay and lag of signals
    sensors       bias, gain, delay, lag, quantum
    bodies        payload, center of mass x, y, z
    surroundings  gravity tilt x, y; medium density, viscosity
    contacts      friction, softness, restitution
    ============= ==================================================================

    Args:
        model: What :func:`.from_mjcf` or :func:`.from_sysid` returns, or an ``MjSpec``,
            a path or the text of an MJCF.
        trials: Trials whose actions and inputs say how the robot moves; None takes
            those of a robot, else its signals or actions, else it is released around
            its start.
        include: Pattern of names that are kept, as in "\* friction loss", or several.
        exclude: Patterns of names that are left out.

    Raises:
        ValueError: If a pattern fits no effect.
    """
    simulator, every, call = _offered(model, trials)
    return _that_matter(simulator, picked(every, include, exclude), call)


def likely_effects(robot: Robot) -> list[Effect]:
    """Return effects that joints and drives most often have and an MJCF does not say.

    Some may change nothing in the recordings.

    Args:
        robot: Robot from its MJCF, with recordings.
    """
    simulator, every, _ = _offered(robot, None)
    likely = ("* friction loss", "* quadratic damping", "* stiffness", "* lag")
    fitted_by_these = ("* sensor lag", "* cubic *", "* quadratic stiffness", "all *")
    some = picked(every, likely, fitted_by_these, strict=False)
    return _undeclared(simulator, some)


def _offered(
    model: Any, trials: Trials | None
) -> tuple[SimulatorModel, list[Effect], dict[str, Any]]:
    """Return the simulator, all effects of its model, and rows to try them on."""
    robot = model if isinstance(model, Robot) else from_spec(model)
    simulator, trials = robot.simulator, trials or robot.trials
    sizes, call = nominal(simulator, trials, robot.actions)
    driven: list[str] = []
    if trials is not None and trials.inputs is not None:
        driven = [*trials.inputs]
    elif simulator.inputs is not None:
        driven = [*simulator.inputs.inputs(simulator.inputs.sample((1,), seed=0))]
    sd = getattr(simulator.noise, "sd", None)
    noise = None if sd is None else torch.as_tensor(sd).reshape(-1).tolist()
    function: MujocoFunction = simulator.fn  # pyright: ignore[reportAssignmentType]
    every = [
        effect
        for element in elements(function.channels, sizes, driven=driven, noise=noise)
        for effect in element.effects()
    ]
    return simulator, every, call


def _undeclared(simulator: SimulatorModel, effects: Sequence[Effect]) -> list[Effect]:
    """Return the effects of quantities that are no parameters."""
    function: MujocoFunction = simulator.fn  # pyright: ignore[reportAssignmentType]
    declared = {p.quantity for p in function.machines[0].parameters}
    new = []
    for effect in effects:
        change = getattr(effect.apply, "key", None)
        is_new = not isinstance(change, QuantityChange)
        if is_new or not {*change.quantities} <= declared:
            new.append(effect)
    return new


def _that_matter(
    simulator: SimulatorModel, effects: Sequence[Effect], call: dict[str, Any]
) -> list[Effect]:
    """Return the effects that are no parameter and change the readings."""
    bare = simulator.without_noise()
    theta, action = call["theta"], call["action"]
    context = Context(
        index=torch.arange(len(theta), dtype=torch.float64),
        **{k: v for k, v in call.items() if k not in ("theta", "action")},
    )
    new = _undeclared(simulator, effects)
    augmented = AugmentedSimulator(bare, new)
    x = augmented.evaluate(theta, {}, action, context=context)
    least = 1e-9 * (float(np.nanstd(x.double().numpy())) or 1.0)
    kept = []
    for effect in new:
        phi = {effect.name: effect.declared_draws()[: len(theta)].to(theta.dtype)}
        changed = augmented.evaluate(theta, phi, action, context=context)
        if bool(((changed - x).abs().nan_to_num(torch.inf) > least).any()):
            kept.append(effect)
    return kept
