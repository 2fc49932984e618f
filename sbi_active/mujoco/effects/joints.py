"""Effects of joints: friction, damping, springs, inertia, zeros."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from sbi_active.criticism.effects.effect import Effect
from sbi_active.mujoco.effects.acting import (
    force_effect,
    half_normal,
    model_effect,
    normal,
)
from sbi_active.mujoco.effects.frictions import of_friction
from sbi_active.mujoco.effects.insertions import Transmission, least_compliance
from sbi_active.mujoco.effects.nominal import Nominal
from sbi_active.mujoco.effects.powers import PowerForce
from sbi_active.mujoco.effects.ties import Group
from sbi_active.mujoco.effects.writing import Polynomial, QuantityChange, ZeroOffset
from sbi_active.mujoco.models.names import element_id
from sbi_active.mujoco.models.quantities import is_hinge

__all__ = ["of_joints"]

#: One prior deviation, as a share of the generalized force along nominal trajectories.
SHARE = 0.2
#: Share of the inertia that a joint feels.
INERTIA = 0.2
#: Play, and the deflection of a spring under a typical force, in ranges of positions.
PLAY, DEFLECTION = 0.05, 0.1
#: Least play that is simulated, as a share of a deviation.
LEAST = 0.2
#: Zero offset, as a share of the range of positions, and at most, rad or m.
ZERO, MOST = 0.1, 0.1


def of_joints(group: Group, sizes: Nominal) -> Iterator[Effect]:
    """Yield the effects of joints that share each phi, or of one.

    Args:
        group: Group of joints.
        sizes: Sizes of the model.
    """
    model = sizes.model
    dofs = [
        int(model.jnt_dofadr[element_id(model, "joint", name)]) for name in group.names
    ]
    q, v = (float(value[dofs].mean()) for value in (sizes.position, sizes.velocity))
    force = SHARE * float(sizes.force[dofs].mean())
    turns = is_hinge(model, group.names[0])
    unit, length = ("N m", "rad") if turns else ("N", "m")
    per = f"{unit}/{length}"

    def change(attribute: str) -> QuantityChange:
        return QuantityChange("joint", group.names, attribute)

    def make(what: str, change: Any, **options: Any) -> Effect:
        return model_effect(f"{group.label} {what}", change, **options)

    yield make(
        "friction loss",
        change("frictionloss"),
        prior=half_normal(force),
        units=unit,
        family="friction",
        describe=f"dry friction in {group.label}",
    )
    yield from of_friction(group, sizes, force, unit)
    yield make(
        "viscous damping",
        change("damping"),
        prior=half_normal(force / v),
        units=f"{unit} s/{length}",
        family="friction",
        describe=f"friction in {group.label} in proportion to the speed",
    )
    for power, word in ((2, "quadratic"), (3, "cubic")):
        yield _power(
            group,
            model,
            "damping",
            power,
            name=f"{group.label} {word} damping",
            prior=half_normal(force / v**power),
            units=f"{unit} (s/{length})^{power}",
            family="friction",
            describe=f"friction in {group.label} with power {power} of the speed",
        )
    yield make(
        "stiffness",
        change("stiffness"),
        prior=half_normal(force / q),
        units=per,
        family="spring",
        describe=f"a spring in {group.label} towards its springref",
    )
    for power, word in ((2, "quadratic"), (3, "cubic")):
        yield _power(
            group,
            model,
            "stiffness",
            power,
            name=f"{group.label} {word} stiffness",
            prior=normal(force / q**power),
            units=f"{unit}/{length}^{power}",
            family="spring",
            describe=f"a spring in {group.label} with power {power} of the deflection",
        )
    yield make(
        "armature",
        change("armature"),
        prior=half_normal(INERTIA * float(sizes.inertia[dofs].mean())),
        units="kg m^2" if turns else "kg",
        family="inertia",
        describe=f"inertia of a rotor in {group.label}",
    )
    yield make(
        "zero offset",
        ZeroOffset(group.names),
        prior=normal(min(ZERO * q, MOST)),
        units=length,
        family="geometry",
        describe=f"{group.label} reads zero elsewhere",
    )
    yield from _transmissions(group, sizes, q, force / SHARE, make)


def _transmissions(
    group: Group, sizes: Nominal, q: float, force: float, make: Any
) -> Iterator[Effect]:
    """Yield play and a spring behind joints that are alone in their body."""
    model = sizes.model
    places = [element_id(model, "joint", name) for name in group.names]
    if any(model.body_jntnum[model.jnt_bodyid[i]] != 1 for i in places):
        return
    dofs = [int(model.jnt_dofadr[i]) for i in places]
    behind = tuple(
        max(float(sizes.inertia[k] - model.dof_armature[k]), 1e-12) for k in dofs
    )
    length = "rad" if is_hinge(model, group.names[0]) else "m"
    unit = f"{length}/N m" if length == "rad" else f"{length}/N"
    step = float(model.opt.timestep)
    stiffest = max(
        least_compliance(inertia, float(model.dof_armature[k]), step)
        for inertia, k in zip(behind, dofs, strict=True)
    )
    yield make(
        "backlash",
        Transmission(group.names, False, behind, step, LEAST * PLAY * q),
        prior=half_normal(PLAY * q),
        units=length,
        family="transmission",
        describe=f"play between the motor and what {group.label} moves",
    )
    yield make(
        "series elasticity",
        Transmission(group.names, True, behind, step, stiffest),
        prior=half_normal(DEFLECTION * q / force),
        units=unit,
        family="transmission",
        describe=f"a spring between the motor and what {group.label} moves",
    )


def _power(
    group: Group, model: Any, what: Any, power: Any, *, name: str, **options: Any
) -> Effect:
    """Return an effect with a power, native where this MuJoCo has it."""
    if hasattr(model, "dof_dampingpoly"):
        return model_effect(name, Polynomial(group.names, what, power), **options)
    places = []
    for joint in group.names:
        i = element_id(model, "joint", joint)
        rest = float(model.qpos_spring[model.jnt_qposadr[i]])
        places.append((int(model.jnt_qposadr[i]), int(model.jnt_dofadr[i]), rest))
    return force_effect(name, PowerForce(tuple(places), what, power), **options)
