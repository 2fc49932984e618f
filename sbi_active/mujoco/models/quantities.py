r"""Quantities of a model by their MJCF names, and the fields of ``mjModel`` behind.

A quantity is ``element.attribute``, as in "hinge.damping" or "bob.mass", or
"option.density"; :data:`ATTRIBUTES` lists them. Each is one number q of which fields
are multiples, so that it is written without another compilation; MuJoCo's
``mj_setConst`` then renews what follows from masses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sbi_active.mujoco.models.names import (
    element_id,
    names_of,
    require_name,
    scalar_joints,
)
from sbi_active.mujoco.models.spec import mujoco_of


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
    for part in name.split("."):
        model = getattr(model, part)
    return model


def set_to(model: Any, entry: Entry, value: float) -> None:
    """Write a number."""
    *owner, name = entry.field.split(".")
    own = field_of(model, ".".join(owner)) if owner else model
    if entry.index:
        getattr(own, name)[entry.index] = value
    else:
        setattr(own, name, value)


def add_to(model: Any, entry: Entry, value: float) -> None:
    """Add to a number."""
    now = field_of(model, entry.field)
    set_to(model, entry, float(now[entry.index] if entry.index else now) + value)


def copied(model: Any, names: Iterable[str]) -> dict[str, Any]:
    """Return copies of fields, by name."""
    return {name: np.array(field_of(model, name)) for name in sorted({*names})}


def restore(model: Any, fields: dict[str, Any]) -> None:
    """Write fields back as they were copied."""
    for name, value in fields.items():
        if value.ndim:
            field_of(model, name)[...] = value
        else:
            set_to(model, Entry(name, ()), value.item())


Entries = Callable[[Any, int], list[Entry]]


@dataclass(frozen=True)
class Attribute:
    """An attribute of a kind of element.

    Attributes:
        fields: Fields of ``mjModel`` that are written.
        entries: Function of a model and the element's number that returns the numbers
            that follow the attribute.
        unit: Unit in SI; N, L and I in braces are those of the joint.
        is_signed: Whether MuJoCo's equations have a meaning for it below zero.
    """

    fields: tuple[str, ...]
    entries: Entries
    unit: str = ""
    is_signed: bool = True


def _at(
    field: str,
    *place: int,
    unit: str = "",
    by: str = "",
    factor: float = 1.0,
    is_signed: bool = True,
) -> Attribute:
    """Return an attribute that is one number of a field.

    Args:
        field: Name of the field.
        *place: Further indices behind the element's.
        unit: Unit in SI.
        by: Field that says where the element's numbers are; "" for its number.
        factor: Factor by which the attribute is multiplied.
        is_signed: Whether it may be below zero.
    """

    def entries(model: Any, i: int) -> list[Entry]:
        first = int(getattr(model, by)[i]) if by else i
        return [Entry(field, (first, *place), factor)]

    return Attribute((field,), entries, unit, is_signed)


def _option(name: str, unit: str) -> Attribute:
    return Attribute(
        (f"opt.{name}",), lambda model, i: [Entry(f"opt.{name}", ())], unit
    )


def _mass(model: Any, i: int) -> list[Entry]:
    mass = float(model.body_mass[i])
    inertia = model.body_inertia[i] / mass if mass > 0 else np.zeros(3)
    parts = [Entry("body_inertia", (i, k), float(inertia[k])) for k in range(3)]
    return [Entry("body_mass", (i,)), *parts]


def _gain(model: Any, i: int) -> list[Entry]:
    gain, bias = float(model.actuator_gainprm[i, 0]), model.actuator_biasprm[i]
    entries = [Entry("actuator_gainprm", (i, 0))]
    if gain and bias[1] == -gain:  # a position servo: gain (ctrl - q)
        entries.append(Entry("actuator_biasprm", (i, 1), -1.0))
    return entries


def _gravity(model: Any, i: int) -> list[Entry]:
    g = model.opt.gravity
    size = float(np.linalg.norm(g)) or 1.0
    return [
        Entry("opt.gravity", (k,), float(g[k]) / size)
        for k in sorted(range(3), key=lambda k: -abs(g[k]))
        if g[k] or not g.any()
    ]


#: Fields that say that a frame is another's, and no longer hold for a center of mass.
FRAMES = ("body_sameframe", "geom_sameframe")


def _center(k: int) -> Attribute:
    return Attribute(("body_ipos", *FRAMES), _at("body_ipos", k).entries, "m")


GAIN = "actuator_gainprm", "actuator_biasprm"
#: Attributes of each kind of element, by their MJCF names.
ATTRIBUTES: dict[str, dict[str, Attribute]] = {
    "joint": {
        "damping": _at("dof_damping", by="jnt_dofadr", unit="{N} s/{L}"),
        "armature": _at("dof_armature", by="jnt_dofadr", unit="{I}", is_signed=False),
        "frictionloss": _at(
            "dof_frictionloss", by="jnt_dofadr", unit="{N}", is_signed=False
        ),
        "stiffness": _at("jnt_stiffness", unit="{N}/{L}"),
        "springref": _at("qpos_spring", by="jnt_qposadr", unit="{L}"),
    },
    "body": {
        # The inertia in proportion.
        "mass": Attribute(("body_mass", "body_inertia"), _mass, "kg", is_signed=False),
        "com_x": _center(0),
        "com_y": _center(1),
        "com_z": _center(2),
    },
    "actuator": {
        "gear": _at("actuator_gear", 0),
        "gain": Attribute(GAIN, _gain),  # of a servo kp, and its bias with it
        "kp": Attribute(GAIN, _gain, "{N}/{L}"),
        "kv": _at("actuator_biasprm", 2, factor=-1.0, unit="{N} s/{L}"),
        "timeconst": _at("actuator_dynprm", 0, unit="s"),
    },
    "geom": {
        "friction": _at("geom_friction", 0, is_signed=False),
        "torsional_friction": _at("geom_friction", 1, unit="m", is_signed=False),
        "rolling_friction": _at("geom_friction", 2, unit="m", is_signed=False),
        "timeconst": _at("geom_solref", 0, unit="s"),
        "dampratio": _at("geom_solref", 1),
    },
    "tendon": {
        "stiffness": _at("tendon_stiffness"),
        "damping": _at("tendon_damping"),
        "frictionloss": _at("tendon_frictionloss", is_signed=False),
    },
    "option": {
        "gravity": Attribute(("opt.gravity",), _gravity, "m/s^2"),
        "density": _option("density", "kg/m^3"),
        "viscosity": _option("viscosity", "Pa s"),
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

    def loosen(self, model: Any) -> bool:
        """Tell MuJoCo, in place, that a center of mass that is written is elsewhere.

        Returns:
            Whether it is a center of mass.
        """
        if not self.attribute.startswith("com_"):
            return False
        i = element_id(model, "body", self.name)
        same = mujoco_of().mjtSameFrame
        own = model.geom_bodyid == i
        inertial = int(same.mjSAMEFRAME_INERTIA), int(same.mjSAMEFRAME_INERTIAROT)
        model.geom_sameframe[own & np.isin(model.geom_sameframe, inertial)] = 0
        model.body_sameframe[i] = 0
        return True


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
        for each in attributes
    ]
    found = [
        q
        for q in every
        if (q.name, q.attribute) == (name, attribute) and wanted in ("", q.kind)
    ]
    if not dot or not found:
        require_name(rest, map(str, every), "quantity, 'element.attribute',")
    if len(found) > 1:
        kinds = ", ".join(f"{q.kind}:{q}" for q in found)
        raise ValueError(
            f"expected one quantity {text!r}; got {len(found)}; pass one of {kinds}"
        )
    return found[0]


def units_of(model: Any, joint: str) -> dict[str, str]:
    """Return the units of force, length and inertia of a joint: N, L and I."""
    kind = int(model.jnt_type[element_id(model, "joint", joint)])
    if kind == int(mujoco_of().mjtJoint.mjJNT_SLIDE):
        return {"N": "N", "L": "m", "I": "kg"}
    return {"N": "N m", "L": "rad", "I": "kg m^2"}


def joint_of_actuator(model: Any, actuator: str) -> str | None:
    """Return the joint that an actuator drives, None if it is something else."""
    mujoco = mujoco_of()
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
