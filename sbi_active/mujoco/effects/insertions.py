r"""Transmissions that give: a joint is put between a motor and what it moves.

The joint that the model has stays the motor's: the actuator, armature, friction and the
encoder are on its side. A joint that is inserted behind it on the same axis moves the
body further, and feels its inertia without the armature. Between the two is play of a
width :math:`\phi` (backlash), or a spring with a compliance :math:`\phi`,

.. math::
    |q_i| \le \phi / 2, \qquad \tau = -q_i / \phi - d\, \dot q_i .

Where the joint has no armature the motor's side gets a small part of the inertia behind
it. The spring is damped to a fifth of what is critical. What is stiffer, or plays less,
than a simulation of this time step can follow is mixed from the least that it can and
none. At the start it carries the load.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from typing_extensions import override

from sbi_active.arrays import Array
from sbi_active.mujoco.models.changes import Insertion
from sbi_active.mujoco.models.names import element_id
from sbi_active.mujoco.models.spec import mujoco

#: What an inserted joint is called after its joint.
INSERTED = " (inserted)"
#: Inertia of the motor's side where the model gives none, in that behind the joint.
ROTOR = 0.03
DAMPING = 0.2  # of critical
STIFFEST = 1.0  # radians of its oscillation a step
STOP = (0.95, 0.99, 0.001, 0.5, 2.0)  # solimp of the play's ends


@dataclass(frozen=True)
class Transmission(Insertion):
    """Puts play or a spring between joints and what they move.

    Writes ``jnt_range`` of inserted joints, or their ``jnt_stiffness`` and
    ``dof_damping``.

    Attributes:
        names: Names of the joints.
        is_spring: Whether it is a spring rather than play.
        inertias: Inertia behind each joint, kg m^2 or kg.
        step: Time step of the simulation, s.
        least: Smallest phi that is simulated.
    """

    names: tuple[str, ...]
    is_spring: bool
    inertias: tuple[float, ...]
    step: float
    least: float

    @override
    def fields(self) -> tuple[str, ...]:
        return ("jnt_stiffness", "dof_damping") if self.is_spring else ("jnt_range",)

    @override
    def share(self, phi: Array) -> float:
        return float(np.clip(phi[0] / self.least, 0.0, 1.0))

    @override
    def edit(self, spec: Any) -> None:
        for name, inertia in zip(self.names, self.inertias, strict=True):
            joint, added = spec.joint(name), name + INSERTED
            if spec.joint(added) is None:
                if joint.armature <= 0:
                    joint.armature = ROTOR * inertia
                inserted = joint.parent.add_joint(name=added)
                _like(inserted, joint)
            if not self.is_spring:
                inserted = spec.joint(added)
                inserted.limited = mujoco.mjtLimited.mjLIMITED_TRUE
                inserted.range = [-0.5, 0.5]
                inserted.solref_limit = [2 * self.step, 1.0]
                inserted.solimp_limit = STOP

    @override
    def write(self, model: Any, phi: Array) -> None:
        width = max(float(phi[0]), self.least)
        for name, inertia in zip(self.names, self.inertias, strict=True):
            i = element_id(model, "joint", name + INSERTED)
            if not self.is_spring:
                model.jnt_range[i] = -0.5 * width, 0.5 * width
                continue
            motor = float(model.dof_armature[model.jnt_dofadr[i] - 1])
            reduced = inertia * motor / (inertia + motor)
            model.jnt_stiffness[i] = 1 / width
            damping = 2 * DAMPING * np.sqrt(reduced / width)
            model.dof_damping[model.jnt_dofadr[i]] = damping

    @override
    def settle(self, model: Any, data: Any, phi: Array) -> None:
        for name in self.names:
            i = element_id(model, "joint", name + INSERTED)
            place, load = model.jnt_qposadr[i], data.qfrc_bias[model.jnt_dofadr[i]]
            if self.is_spring:
                data.qpos[place] = -load / model.jnt_stiffness[i]
            else:
                width = max(float(phi[0]), self.least)
                data.qpos[place] = -0.5 * np.sign(load) * width


def least_compliance(inertia: Array, armature: Array, step: float) -> float:
    """Return the compliance of the stiffest spring that steps can follow everywhere.

    Args:
        inertia: Inertia behind each joint.
        armature: Armature of each joint, 0 for none.
        step: Time step, s.
    """
    motor = np.where(armature > 0, armature, ROTOR * inertia)
    reduced = inertia * motor / (inertia + motor)
    return float((1 / (reduced * (STIFFEST / step) ** 2)).max())


def _like(inserted: Any, joint: Any) -> None:
    """Make a joint like another, without what a class of defaults may add."""
    inserted.type, inserted.axis, inserted.pos = joint.type, joint.axis, joint.pos
    if joint.frame is not None:
        inserted.set_frame(joint.frame)
    inserted.limited = mujoco.mjtLimited.mjLIMITED_FALSE
    inserted.armature = inserted.frictionloss = 0.0
    inserted.ref = inserted.springref = 0.0
    for name in ("stiffness", "damping"):  # numbers, or with a polynomial's behind
        setattr(inserted, name, 0.0 * np.asarray(getattr(inserted, name)))
