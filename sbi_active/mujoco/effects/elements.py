"""Elements that effects belong to: those that are alike together, and one by one."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch

from sbi_active.criticism.effects.changes import Wrapped
from sbi_active.criticism.effects.effect import Effect, UnderKey
from sbi_active.criticism.effects.generic import typical_delay
from sbi_active.criticism.effects.table import rows_of
from sbi_active.mujoco.effects.changes import (
    ActuatorChange,
    ActuatorLaw,
    ContactChange,
    ContactLaw,
    FrictionChange,
    GravityTilt,
    QuantityChange,
    ZeroOffset,
)
from sbi_active.mujoco.effects.insertions import Transmission, least_compliance
from sbi_active.mujoco.models.names import element_id, names_of, scalar_joints
from sbi_active.mujoco.models.quantities import (
    ATTRIBUTES,
    is_movable,
    joint_of_actuator,
    units_of,
)
from sbi_active.mujoco.simulator import Channel
from sbi_active.mujoco.typical import Nominal

TABLE = Path(__file__).with_name("table.md")
ACTUATOR, CONTACT = get_args(ActuatorLaw), get_args(ContactLaw)
READING = ("offset", "gain", "delay", "lag", "quantum")


@dataclass(frozen=True)
class Element:
    """An element of a model, or several that share each phi.

    Attributes:
        kind: Kind, the first column of ``table.md``.
        label: Label that effects are named by.
        changes: What effects may change, by the table's column.
        sizes: Sizes by which priors are scaled, by name.
        words: Units and numbers in braces of the table, by name.
    """

    kind: str
    label: str
    changes: Mapping[str, Any]
    sizes: Mapping[str, float] = field(default_factory=dict)
    words: Mapping[str, str] = field(default_factory=dict)

    def effects(self) -> list[Effect]:
        """Return the effects of the element, in the order of the table."""
        found = []
        for row in rows_of(TABLE):
            if row.of != self.kind or row.changes not in self.changes:
                continue
            hook, apply = "dynamics", self.changes[row.changes]
            if isinstance(apply, Wrapped):
                hook = "input" if apply.inputs else "observation"
            else:
                apply = UnderKey("model", apply)
            how = {"hook": hook, "apply": apply}
            found.append(row.made(self.label, self.sizes, self.words, **how))
        return found


def elements(
    channels: Sequence[Channel],
    sizes: Nominal,
    *,
    driven: Sequence[str],
    noise: Sequence[float] | None,
) -> Iterator[Element]:
    """Yield all elements of a model.

    Args:
        channels: Channels of x.
        sizes: Sizes of the model.
        driven: Actuators whose inputs are signals over time.
        noise: Standard deviation of each channel's noise; None if it is not known.
    """
    model = sizes.model
    delay = typical_delay(torch.as_tensor(sizes.times))
    for names in _alike(*_joints(model)):
        yield _joint(names, sizes)
    for names in _alike(*_actuators(model)):
        yield _actuator(names, sizes, delay, is_driven={*names} <= {*driven})
    late = float(np.float32(delay))  # as that of any simulator's sensor
    for k, channel in enumerate(channels):
        reading = float(sizes.reading[k])
        sd = 0.01 * reading if noise is None else noise[k % len(noise)]
        only = k if len(channels) > 1 else None
        yield Element(
            "sensor",
            f"{channel.name} sensor",
            {f"reading {what}": Wrapped(what, channel=only) for what in READING},
            {"reading": reading, "noise": sd, "delay": late},
            {"unit": channel.unit},
        )
    for names in _alike(*_bodies(model)):
        yield _body(names, model)
    tilts = {f"tilt {axis}": GravityTilt(axis) for axis in ("x", "y")}
    yield Element("gravity", "gravity", tilts)
    yield Element("medium", "medium", _quantities("option", ("option",), model))
    if sizes.has_contacts:
        contacts = {f"contact {what}": ContactChange(what) for what in CONTACT}
        yield Element("contact", "contact", contacts, words={"who": "every contact"})


def _quantities(kind: str, names: tuple[str, ...], model: Any) -> dict[str, Any]:
    """Return changes of the quantities that a version of MuJoCo has."""
    return {
        what: QuantityChange(kind, names, what)
        for what, known in ATTRIBUTES[kind].items()
        if kind == "option" or hasattr(model, known.field)
    }


def _joint(names: tuple[str, ...], sizes: Nominal) -> Element:
    model = sizes.model
    joints = [element_id(model, "joint", name) for name in names]
    dofs = model.jnt_dofadr[joints]
    position = float(sizes.position[dofs].mean())
    speed = float(sizes.velocity[dofs].mean())
    force = 0.2 * float(sizes.force[dofs].mean())
    low, high = (tuple(each[dofs].tolist()) for each in (sizes.lowest, sizes.highest))
    turning = 0.1 * speed  # where static friction has fallen to 1 / e
    changes = _quantities("joint", names, model) | {
        "friction by load": FrictionChange(names, "load"),
        "friction by speed": FrictionChange(names, "speed", speed=turning),
        "zero": ZeroOffset(names),
    }
    if all(a < b for a, b in zip(low, high, strict=True)):
        by_position = FrictionChange(names, "position", low, high)
        changes["friction by position"] = by_position
    if all(model.body_jntnum[model.jnt_bodyid[joints]] == 1):
        armature = model.dof_armature[dofs]
        behind = np.maximum(sizes.inertia[dofs] - armature, 1e-12)
        step, inertias = float(model.opt.timestep), tuple(behind.tolist())
        least = least_compliance(behind, armature, step)
        play = 0.2 * 0.05 * position  # the least that is simulated
        changes["play"] = Transmission(names, False, inertias, step, play)
        changes["spring"] = Transmission(names, True, inertias, step, least)
    return Element(
        "joint",
        _common(names),
        changes,
        sizes={
            "force": force,
            "load": force / 0.2,
            "position": position,
            "speed": speed,
            "inertia": float(sizes.inertia[dofs].mean()),
            "zero": min(0.1 * position, 0.1),
        },
        words={
            **units_of(model, names[0]),
            "low": ", ".join(f"{value:.3g}" for value in low),
            "high": ", ".join(f"{value:.3g}" for value in high),
            "speed": f"{turning:.2g}",
        },
    )


def _actuator(
    names: tuple[str, ...], sizes: Nominal, delay: float, *, is_driven: bool
) -> Element:
    places = [element_id(sizes.model, "actuator", name) for name in names]
    joint = joint_of_actuator(sizes.model, names[0])
    changes: dict[str, Any] = {what: ActuatorChange(names, what) for what in ACTUATOR}
    if is_driven:
        what = "input delay", "input lag"
        changes |= {each: Wrapped(each, names) for each in what}
    return Element(
        "actuator",
        _common(names),
        changes,
        sizes={
            "force": float(sizes.actuator_force[places].mean()),
            "speed": float(sizes.actuator_velocity[places].mean()),
            "delay": delay,
        },
        words={} if joint is None else units_of(sizes.model, joint),
    )


def _body(names: tuple[str, ...], model: Any) -> Element:
    i = element_id(model, "body", names[0])
    mass = float(model.body_mass[i])
    radius = float(np.sqrt(model.body_inertia[i].sum() / (2 * mass)))
    changes = _quantities("body", names, model)
    # The axes of symmetric bodies need not be mirrored alike.
    is_free = len(names) == 1 and is_movable(model, names[0])
    if not is_free:
        changes = {"mass": changes["mass"]}
    sizes = {"mass": mass, "radius": radius}
    return Element("body", _common(names), changes, sizes)


# What is alike: elements of one class, with numbers that differ by no more than 5 %.


def _joints(model: Any) -> tuple[list[str], list[Any]]:
    joints, features = scalar_joints(model), []
    for i in joints.values():
        dof, body = int(model.jnt_dofadr[i]), int(model.jnt_bodyid[i])
        numbers = [model.dof_M0[dof], model.body_mass[body]]
        numbers += [np.ptp(model.jnt_range[i]), *np.abs(model.jnt_axis[i])]
        features.append(((model.jnt_type[i], _depth(model, body)), numbers))
    return [*joints], features


def _actuators(model: Any) -> tuple[list[str], list[Any]]:
    """Return actuators, alike where they do the same to joints that are alike."""
    groups, joints = _alike(*_joints(model)), names_of(model, "joint")
    names, features = names_of(model, "actuator"), []
    for i in range(len(names)):
        joint = int(model.actuator_trnid[i, 0])
        driven = joints[joint] if 0 <= joint < len(joints) else ""
        place = next((k for k, group in enumerate(groups) if driven in group), -1)
        numbers = [*model.actuator_gainprm[i, :3], *model.actuator_biasprm[i, :3]]
        numbers.append(abs(model.actuator_gear[i, 0]))
        features.append(((model.actuator_trntype[i], place), numbers))
    return names, features


def _bodies(model: Any) -> tuple[list[str], list[Any]]:
    names, features = [], []
    for i, name in enumerate(names_of(model, "body")):
        if i and model.body_weldid[i] != 0 and model.body_mass[i] > 0:
            names.append(name)
            numbers = [model.body_mass[i], *model.body_inertia[i]]
            features.append(((_depth(model, i),), numbers))
    return names, features


def _alike(names: Sequence[str], features: Sequence[Any]) -> list[tuple[str, ...]]:
    """Return groups of elements that are alike, then each element."""
    groups: list[list[int]] = []
    for i, (own, numbers) in enumerate(features):
        for group in groups:
            other, others = features[group[0]]
            if own == other and np.allclose(numbers, others, rtol=0.05, atol=1e-9):
                group.append(i)
                break
        else:
            groups.append([i])
    tied = [tuple(names[i] for i in group) for group in groups if len(group) > 1]
    return [*tied, *((name,) for name in names)]


def _common(names: Sequence[str]) -> str:
    """Return a label for elements, that of several as in "all calf_joint"."""
    if len(names) == 1:
        return names[0]
    end = os.path.commonprefix([name[::-1] for name in names])[::-1]
    begin = os.path.commonprefix([*names])
    shared = max(end, begin, key=len).strip("_- ./")
    is_word = re.search(r"[A-Za-z]", shared)
    return f"all {shared}" if is_word else f"all of {', '.join(names)}"


def _depth(model: Any, body: int) -> int:
    depth = 0
    while body:
        body = int(model.body_parentid[body])
        depth += 1
    return depth
