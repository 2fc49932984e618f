r"""Quantities of a model by their MJCF names, and the fields of ``mjModel`` behind.

A quantity is ``element.attribute``, as in "hinge.damping" or "bob.mass", or
"option.density"; :data:`ATTRIBUTES` lists them. Each is one number q of which fields
are multiples, so that it is written without another compilation; MuJoCo's
``mj_setConst`` then renews what follows from masses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from typing import Any

import numpy as np

from sbi_active.arrays import Array
from sbi_active.expected import require
from sbi_active.mujoco.models.names import (
    element_id,
    names_of,
    require_name,
    scalar_joints,
)
from sbi_active.mujoco.models.spec import mujoco


@dataclass(frozen=True)
class Entry:
    """A number of a model that follows a quantity.

    Attributes:
        field: Name in ``mjModel``, as in "dof_damping" or "opt.density".
        index: Index of the number in the field; () for a field that is one number.
        factor: Factor by which the quantity is multiplied.
    """

    field: str
    index: tuple[int, ...]
    factor: float = 1.0


def field_of(model: Any, name: str) -> Any:
    """Return a field: a view of the model's memory, or a number."""
    return attrgetter(name)(model)


def set_field(model: Any, name: str, value: Array) -> None:
    """Write a field, an array or a number."""
    owner, _, last = name.rpartition(".")
    own = field_of(model, owner) if owner else model
    setattr(own, last, value if value.ndim else value.item())


def add_to(model: Any, entry: Entry, value: float) -> None:
    """Add to a number."""
    now = np.array(field_of(model, entry.field))
    now[entry.index] += value
    set_field(model, entry.field, now)


@dataclass(frozen=True)
class Attribute:
    """An attribute of a kind of element: a number of a field, and what follows it.

    Attributes:
        field: Field of ``mjModel``.
        place: Indices behind the element's.
        unit: Unit in SI; N, L and I in braces are those of the joint.
        by: Field that says where the element's numbers are; "" for its number.
        factor: Factor by which the attribute is multiplied.
        is_signed: Whether MuJoCo's equations have a meaning for it below zero.
        further: Function of a model and the element's number that returns the entries
            of other fields.
        others: These fields, and others that are written.
    """

    field: str
    place: tuple[int, ...] = ()
    unit: str = ""
    by: str = ""
    factor: float = 1.0
    is_signed: bool = True
    further: Callable[[Any, int], list[Entry]] | None = None
    others: tuple[str, ...] = ()

    @property
    def fields(self) -> tuple[str, ...]:
        """Fields that are written."""
        return self.field, *self.others

    def entries(self, model: Any, i: int) -> list[Entry]:
        """Return the numbers of a model that follow that of an element."""
        index = (int(field_of(model, self.by)[i]) if self.by else i, *self.place)
        if self.field.startswith("opt."):
            index = self.place
        own = Entry(self.field, index, self.factor)
        return [own, *(self.further(model, i) if self.further else ())]


def _inertia(model: Any, i: int) -> list[Entry]:
    """Return the inertia of a body, in proportion to its mass."""
    mass = float(model.body_mass[i])
    inertia = model.body_inertia[i] / mass if mass > 0 else np.zeros(3)
    return [Entry("body_inertia", (i, k), float(inertia[k])) for k in range(3)]


def _servo(model: Any, i: int) -> list[Entry]:
    """Return the bias of a position servo, whose force is gain (ctrl - q)."""
    gain, bias = float(model.actuator_gainprm[i, 0]), model.actuator_biasprm[i]
    is_servo = gain and bias[1] == -gain
    return [Entry("actuator_biasprm", (i, 1), -1.0)] if is_servo else []


#: Fields that say that a frame is another's, and no longer hold for a center of mass.
FRAMES = ("body_sameframe", "geom_sameframe")
KP = Attribute(
    "actuator_gainprm", (0,), "{N}/{L}", further=_servo, others=("actuator_biasprm",)
)
DOF, QPOS = "jnt_dofadr", "jnt_qposadr"
Positive = partial(Attribute, is_signed=False)
#: Attributes of each kind of element, by their MJCF names.
ATTRIBUTES: dict[str, dict[str, Attribute]] = {
    "joint": {
        "damping": Attribute("dof_damping", (), "{N} s/{L}", DOF),
        "damping^2": Attribute("dof_dampingpoly", (0,), "{N} (s/{L})^2", DOF),
        "damping^3": Attribute("dof_dampingpoly", (1,), "{N} (s/{L})^3", DOF),
        "armature": Positive("dof_armature", (), "{I}", DOF),
        "frictionloss": Positive("dof_frictionloss", (), "{N}", DOF),
        "stiffness": Attribute("jnt_stiffness", (), "{N}/{L}"),
        "stiffness^2": Attribute("jnt_stiffnesspoly", (0,), "{N}/{L}^2"),
        "stiffness^3": Attribute("jnt_stiffnesspoly", (1,), "{N}/{L}^3"),
        "springref": Attribute("qpos_spring", (), "{L}", QPOS),
    },
    "body": {
        "mass": Positive(
            "body_mass", (), "kg", further=_inertia, others=("body_inertia",)
        ),
        "com_x": Attribute("body_ipos", (0,), "m", others=FRAMES),
        "com_y": Attribute("body_ipos", (1,), "m", others=FRAMES),
        "com_z": Attribute("body_ipos", (2,), "m", others=FRAMES),
    },
    "actuator": {
        "gear": Attribute("actuator_gear", (0,)),
        "kp": KP,
        "kv": Attribute("actuator_biasprm", (2,), "{N} s/{L}", factor=-1.0),
        "timeconst": Attribute("actuator_dynprm", (0,), "s"),
    },
    "geom": {
        "friction": Positive("geom_friction", (0,)),
        "torsional_friction": Positive("geom_friction", (1,), "m"),
        "rolling_friction": Positive("geom_friction", (2,), "m"),
        "timeconst": Attribute("geom_solref", (0,), "s"),
        "dampratio": Attribute("geom_solref", (1,)),
    },
    "tendon": {
        "stiffness": Attribute("tendon_stiffness"),
        "damping": Attribute("tendon_damping"),
        "frictionloss": Positive("tendon_frictionloss"),
    },
    "option": {
        "density": Attribute("opt.density", unit="kg/m^3"),
        "viscosity": Attribute("opt.viscosity", unit="Pa s"),
    },
}


@dataclass(frozen=True)
class Quantity:
    """One number of a model.

    Attributes:
        kind: Kind of the element: "joint", "body", "actuator", "geom", "tendon",
            "option".
        name: Name of the element; "option" for those of the whole model.
        attribute: Attribute of the element, as in :data:`ATTRIBUTES`.
    """

    kind: str
    name: str
    attribute: str

    def __str__(self) -> str:
        return f"{self.name}.{self.attribute}"

    @property
    def known(self) -> Attribute:
        """What is known of the attribute."""
        return ATTRIBUTES[self.kind][self.attribute]

    @property
    def is_center(self) -> bool:
        """Whether it is a center of mass."""
        return self.attribute.startswith("com_")

    def entries(self, model: Any) -> list[Entry]:
        """Return the numbers of a model that follow it."""
        i = 0 if self.kind == "option" else element_id(model, self.kind, self.name)
        return self.known.entries(model, i)

    def unit(self, model: Any) -> str:
        """Return its unit in SI, as far as the model tells it."""
        unit, joint = self.known.unit, self.name
        if "{" not in unit:
            return unit
        if self.kind == "actuator":
            joint = joint_of_actuator(model, self.name)
        return "" if joint is None else unit.format(**units_of(model, joint))

    def loosen(self, model: Any) -> None:
        """Tell MuJoCo, in place, that a center of mass that is written is elsewhere."""
        if not self.is_center:
            return
        i = element_id(model, "body", self.name)
        same = mujoco.mjtSameFrame
        own = model.geom_bodyid == i
        inertial = int(same.mjSAMEFRAME_INERTIA), int(same.mjSAMEFRAME_INERTIAROT)
        model.geom_sameframe[own & np.isin(model.geom_sameframe, inertial)] = 0
        model.body_sameframe[i] = 0


def find_quantity(model: Any, text: str) -> Quantity:
    """Return the quantity that is called "element.attribute".

    Args:
        model: Compiled model.
        text: Name of the quantity; "joint:element.attribute" where elements of two
            kinds share a name and an attribute.

    Raises:
        ValueError: If there is no such element or attribute, with the nearest ones.
    """
    wanted, _, rest = text.rpartition(":")
    name, dot, attribute = rest.rpartition(".")
    names = {kind: names_of(model, kind) for kind in ATTRIBUTES if kind != "option"}
    names |= {"joint": scalar_joints(model), "option": ["option"]}
    every = [
        Quantity(kind, own, each)
        for kind, attributes in ATTRIBUTES.items()
        for own in names[kind]
        for each, known in attributes.items()
        if kind == "option" or hasattr(model, known.field)  # from a version on
    ]
    found = [
        q
        for q in every
        if (q.name, q.attribute) == (name, attribute) and wanted in ("", q.kind)
    ]
    if not dot or not found:
        require_name(rest, map(str, every), "quantity 'element.attribute'")
    kinds = ", ".join(f"{q.kind}:{q}" for q in found)
    expected, advice = f"one quantity {text!r}", f"pass one of {kinds}"
    require(len(found) == 1, expected, len(found), advice)
    return found[0]


def units_of(model: Any, joint: str) -> dict[str, str]:
    """Return the units of force, length and inertia of a joint: N, L and I."""
    kind = int(model.jnt_type[element_id(model, "joint", joint)])
    if kind == int(mujoco.mjtJoint.mjJNT_SLIDE):
        return {"N": "N", "L": "m", "I": "kg"}
    return {"N": "N m", "L": "rad", "I": "kg m^2"}


def joint_of_actuator(model: Any, actuator: str) -> str | None:
    """Return the joint that an actuator drives, None if it is something else."""
    i = element_id(model, "actuator", actuator)
    joints = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT
    if int(model.actuator_trntype[i]) not in map(int, joints):
        return None
    return names_of(model, "joint")[int(model.actuator_trnid[i, 0])]


def is_movable(model: Any, body: str) -> bool:
    """Return whether a body's center of mass can be written.

    The inertia matrix of a body that is compiled as simple has no room for it.
    """
    return not int(model.body_simple[element_id(model, "body", body)])
