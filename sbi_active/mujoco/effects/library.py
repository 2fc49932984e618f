"""The library of effects that a plain model lacks, enumerated from the model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch

from sbi_active.actions import ActionSpace
from sbi_active.criticism.data.trials import Trials
from sbi_active.criticism.effects.augmented import AugmentedSimulator
from sbi_active.criticism.effects.effect import Context, Effect
from sbi_active.criticism.effects.patterns import as_patterns, picked, unmatched
from sbi_active.mujoco.effects.actuators import of_actuators
from sbi_active.mujoco.effects.joints import of_joints
from sbi_active.mujoco.effects.nominal import Nominal, nominal
from sbi_active.mujoco.effects.sensors import of_sensors
from sbi_active.mujoco.effects.surroundings import (
    of_bodies,
    of_contacts,
    of_surroundings,
)
from sbi_active.mujoco.effects.ties import (
    actuator_groups,
    body_groups,
    joint_groups,
)
from sbi_active.mujoco.effects.writing import QuantityChange, is_parameter
from sbi_active.mujoco.models.names import names_of, require_name
from sbi_active.mujoco.robot import Robot, from_spec
from sbi_active.mujoco.simulator import MujocoFunction
from sbi_active.simulation import SimulatorModel

__all__ = ["likely_effects", "mjcf_effects"]

#: Change of x by a prior deviation, in deviations of x, that counts as none.
NOTHING = 1e-9
#: Patterns of effects that robots most often have, and of others that these fit.
LIKELY = ("* friction loss", "* quadratic damping", "* stiffness", "* lag")
UNLIKELY = ("* sensor lag", "* cubic *", "* quadratic stiffness", "all *")


def mjcf_effects(
    model: Any,
    *,
    trials: Trials | None = None,
    actions: ActionSpace | None = None,
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
        model: The simulator of :func:`.from_mjcf` or :func:`.from_sysid`, or what they
            return, or an ``MjSpec``, a path or the text of an MJCF.
        trials: Trials whose actions and inputs say how the robot moves; None takes
            those of a robot, else its signals or actions, else it is released around
            its start.
        actions: Actions in place of the robot's.
        include: Pattern of names that are kept, as in "\* friction loss", or several.
        exclude: Patterns of names that are left out.

    Raises:
        ValueError: If a pattern fits no effect.
    """
    simulator, actions, trials = _simulator(model, actions, trials)
    sizes, call = nominal(simulator, trials, actions)
    every = [*_all(simulator, sizes, trials)]
    wanted, without = as_patterns(include), as_patterns(exclude)
    for pattern in unmatched(every, [*wanted, *without]):
        names = [e.name for e in every]
        require_name(pattern, names, "effect, or a pattern of some,")
    kept = picked(every, wanted, without)
    return _that_matter(simulator, kept, call)


def likely_effects(robot: Robot, trials: Trials) -> list[Effect]:
    """Return effects that joints and drives most often have and an MJCF does not say.

    Args:
        robot: Robot from its MJCF.
        trials: Trials whose actions and inputs say how it moves.
    """
    simulator, actions, trials = _simulator(robot, None, trials)
    sizes, call = nominal(simulator, trials, actions)
    kept = picked(_all(simulator, sizes, trials), LIKELY, UNLIKELY)
    return _that_matter(simulator, kept, call)


def _simulator(model: Any, actions: Any, trials: Any) -> tuple[Any, Any, Any]:
    if isinstance(model, Robot):
        return model.simulator, actions or model.actions, trials or model.trials
    if not isinstance(model, SimulatorModel):
        return from_spec(model), actions, trials
    if not isinstance(model.fn, MujocoFunction):
        raise TypeError(
            "expected a simulator of from_mjcf or from_sysid; got another; pass the "
            "MJCF, or write down its effects"
        )
    return model, actions, trials


def _all(
    simulator: SimulatorModel, sizes: Nominal, trials: Trials | None
) -> Iterator[Effect]:
    function = simulator.fn
    assert isinstance(function, MujocoFunction)
    model = function.model
    driven: list[str] = []
    if trials is not None and trials.inputs is not None:
        driven = [*trials.inputs]
    elif simulator.inputs is not None:
        driven = [*simulator.inputs.inputs(simulator.inputs.sample((1,), seed=0))]
    for group in joint_groups(model):
        yield from of_joints(group, sizes)
    for group in actuator_groups(model):
        known = [name for name in driven if name in names_of(model, "actuator")]
        yield from of_actuators(group, sizes, driven=known)
    sds = getattr(simulator.noise, "sd", None)
    yield from of_sensors(
        function.channels, sizes, None if sds is None else torch.as_tensor(sds)
    )
    for group in body_groups(model):
        yield from of_bodies(group, sizes)
    yield from of_surroundings(sizes)
    yield from of_contacts(sizes)


def _that_matter(
    simulator: SimulatorModel, effects: Sequence[Effect], call: dict[str, Any]
) -> list[Effect]:
    """Return the effects that are no parameter and change the readings."""
    function = simulator.fn
    assert isinstance(function, MujocoFunction)
    bare = SimulatorModel(
        function, sample_times=simulator.sample_times, inputs=simulator.inputs
    )
    theta, action = call["theta"], call["action"]
    context = Context(
        index=torch.arange(len(theta), dtype=torch.float64),
        **{k: v for k, v in call.items() if k not in ("theta", "action")},
    )
    new = []
    for effect in effects:
        change = getattr(effect.apply, "key", None)
        known = function.machines[0].parameters
        if not (isinstance(change, QuantityChange) and is_parameter(known, change)):
            new.append(effect)
    augmented = AugmentedSimulator(bare, new)
    x = augmented.evaluate(theta, {}, action, context=context)
    scale = float(np.nanstd(x.double().numpy())) or 1.0
    kept = []
    for effect in new:
        draws = effect.declared_draws()[: len(theta)].to(theta.dtype)
        phi = {effect.name: draws}
        changed = augmented.evaluate(theta, phi, action, context=context)
        moved = (changed - x).abs()
        if bool((moved.nan_to_num(torch.inf) > NOTHING * scale).any()):
            kept.append(effect)
    return kept
