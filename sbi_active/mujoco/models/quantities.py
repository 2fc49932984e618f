r"""Quantities of a model by their MJCF names, and the fields of ``mjModel`` behind.

A quantity is ``element.attribute``, as in "hinge.damping" or "bob.mass", or
"option.density". Each is one number q of which fields are multiples, so that it is
written without another compilation; MuJoCo's ``mj_setConst`` then renews what follows
from masses.

================= ============================================= ====================
kind              attribute                                     fields
================= ============================================= ====================
joint             damping, stiffness, armature, frictionloss    dof_damping,
                                                                jnt_stiffness,
                                                                dof_armature,
                                                                dof_frictionloss
joint             springref                                     qpos_spring
body              mass (inertia in proportion)                  body_mass,
                                                                body_inertia
body              com_x, com_y, com_z                           body_ipos
actuator          gear                                          actuator_gear
actuator          gain (of a servo kp and its bias with it)     actuator_gainprm,
                                                                actuator_biasprm
actuator          kv (of a servo)                               actuator_biasprm
actuator          timeconst                                     actuator_dynprm
geom              friction, torsional_friction,                 geom_friction
                  rolling_friction
geom              timeconst, dampratio                          geom_solref
tendon            stiffness, damping, frictionloss              tendon_stiffness,
                                                                ...
option            gravity, density, viscosity                   opt.gravity, ...
================= ============================================= ====================
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sbi_active.mujoco.models.fields import Entry, field_of
from sbi_active.mujoco.models.names import element_id, names_of, require_name
from sbi_active.mujoco.models.spec import mujoco_of

__all__ = [
    "ATTRIBUTES",
    "FRAMES",
    "NEVER_NEGATIVE",
    "Quantity",
    "find_quantity",
    "is_hinge",
    "is_movable",
    "is_scalar",
    "loosen",
]

Entries = Callable[[Any, int], list[Entry]]


@dataclass(frozen=True)
class Quantity:
    """One number of a model.

    Attributes:
        kind: Kind of the element: "joint", "body", "actuator", "geom", "tendon",
            "option".
        name: Name of the element; "option" for those of the whole model.
        attribute: Attribute of the element, as in the table above.
    """

    kind: str
    name: str
    attribute: str

    def __str__(self) -> str:
        return f"{self.name}.{self.attribute}"

    def entries(self, model: Any) -> list[Entry]:
        """Return the numbers of a model that follow it."""
        i = 0 if self.kind == "option" else element_id(model, self.kind, self.name)
        return ATTRIBUTES[self.kind][self.attribute](model, i)

    def value(self, model: Any) -> float:
        """Return the value in the model."""
        first = self.entries(model)[0]
        now = field_of(model, first.field)
        return float(now[first.index] if first.index else now) / first.factor

    def unit(self, model: Any) -> str:
        """Return its unit in SI, as far as the model tells it."""
        if self.kind in ("joint", "actuator"):
            joint = (
                self.name if self.kind == "joint" else joint_of_actuator(model, self)
            )
            if joint is None:
                return ""
            turns = is_hinge(model, joint)
            return _UNITS[self.kind].get(self.attribute, ("", ""))[0 if turns else 1]
        return _OTHER_UNITS.get((self.kind, self.attribute), "")


def joint_of_actuator(model: Any, quantity: Quantity) -> str | None:
    """Return the joint that an actuator drives, None if it is something else."""
    mujoco = mujoco_of()
    i = element_id(model, "actuator", quantity.name)
    joints = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT
    if int(model.actuator_trntype[i]) not in map(int, joints):
        return None
    return names_of(model, "joint")[int(model.actuator_trnid[i, 0])]


def is_hinge(model: Any, joint: str) -> bool:
    """Return whether a joint turns rather than slides."""
    kind = int(model.jnt_type[element_id(model, "joint", joint)])
    return kind != int(mujoco_of().mjtJoint.mjJNT_SLIDE)


def is_scalar(model: Any, joint: str) -> bool:
    """Return whether a joint is a hinge or a slide."""
    types = mujoco_of().mjtJoint
    kind = int(model.jnt_type[element_id(model, "joint", joint)])
    return kind in (int(types.mjJNT_HINGE), int(types.mjJNT_SLIDE))


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
    every = [
        Quantity(kind, name_, each)
        for kind in ATTRIBUTES
        for name_ in (["option"] if kind == "option" else names_of(model, kind))
        for each in ATTRIBUTES[kind]
        if kind != "joint" or is_scalar(model, name_)
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


def is_movable(model: Any, body: str) -> bool:
    """Return whether a body's center of mass can be written.

    The inertia matrix of a body that is compiled as simple has no room for it.
    """
    return not int(model.body_simple[element_id(model, "body", body)])


#: Fields that say that a frame is another's, and no longer hold for a center of mass.
FRAMES = ("body_sameframe", "geom_sameframe")


def loosen(model: Any, body: str) -> None:
    """Tell MuJoCo that a body's center of mass may be anywhere, in place."""
    i = element_id(model, "body", body)
    same = mujoco_of().mjtSameFrame
    own = model.geom_bodyid == i
    inertial = int(same.mjSAMEFRAME_INERTIA), int(same.mjSAMEFRAME_INERTIAROT)
    model.geom_sameframe[own & np.isin(model.geom_sameframe, inertial)] = 0
    model.body_sameframe[i] = 0


def _dof(field: str) -> Entries:
    return lambda model, i: [Entry(field, (int(model.jnt_dofadr[i]),))]


def _damping(model: Any, i: int) -> list[Entry]:
    return [Entry("dof_damping", (int(model.jnt_dofadr[i]),))]


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


def _at(field: str, *place: int, factor: float = 1.0) -> Entries:
    return lambda model, i: [Entry(field, (i, *place), factor)]


#: Attributes of each kind of element, and the numbers of a model behind them.
ATTRIBUTES: dict[str, dict[str, Entries]] = {
    "joint": {
        "damping": _dof("dof_damping"),
        "armature": _dof("dof_armature"),
        "frictionloss": _dof("dof_frictionloss"),
        "stiffness": _at("jnt_stiffness"),
        "springref": lambda model, i: [
            Entry("qpos_spring", (int(model.jnt_qposadr[i]),))
        ],
    },
    "body": {
        "mass": _mass,
        **{
            f"com_{axis}": _at("body_ipos", k) for k, axis in enumerate(("x", "y", "z"))
        },
    },
    "actuator": {
        "gear": _at("actuator_gear", 0),
        "gain": _gain,
        "kp": _gain,
        "kv": _at("actuator_biasprm", 2, factor=-1.0),
        "timeconst": _at("actuator_dynprm", 0),
    },
    "geom": {
        "friction": _at("geom_friction", 0),
        "torsional_friction": _at("geom_friction", 1),
        "rolling_friction": _at("geom_friction", 2),
        "timeconst": _at("geom_solref", 0),
        "dampratio": _at("geom_solref", 1),
    },
    "tendon": {
        "stiffness": _at("tendon_stiffness"),
        "damping": _at("tendon_damping"),
        "frictionloss": _at("tendon_frictionloss"),
    },
    "option": {
        "gravity": _gravity,
        "density": lambda model, i: [Entry("opt.density", ())],
        "viscosity": lambda model, i: [Entry("opt.viscosity", ())],
    },
}

#: Attributes that MuJoCo's equations have no meaning for below zero.
NEVER_NEGATIVE = frozenset(
    {
        "armature",
        "friction",
        "frictionloss",
        "mass",
        "rolling_friction",
        "torsional_friction",
    }
)

#: Units on hinges and on slides.
_UNITS = {
    "joint": {
        "damping": ("N m s/rad", "N s/m"),
        "stiffness": ("N m/rad", "N/m"),
        "armature": ("kg m^2", "kg"),
        "frictionloss": ("N m", "N"),
        "springref": ("rad", "m"),
    },
    "actuator": {
        "kp": ("N m/rad", "N/m"),
        "kv": ("N m s/rad", "N s/m"),
        "timeconst": ("s", "s"),
    },
}
_OTHER_UNITS = {
    ("body", "mass"): "kg",
    **{("body", f"com_{axis}"): "m" for axis in ("x", "y", "z")},
    ("geom", "torsional_friction"): "m",
    ("geom", "rolling_friction"): "m",
    ("geom", "timeconst"): "s",
    ("option", "gravity"): "m/s^2",
    ("option", "density"): "kg/m^3",
    ("option", "viscosity"): "Pa s",
}
