"""Changes of a model: what is written into which fields."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from sbi_active.mujoco.models.changes import ModelChange
from sbi_active.mujoco.models.fields import Entry, add_to, field_of
from sbi_active.mujoco.models.names import element_id, names_of
from sbi_active.mujoco.models.quantities import ATTRIBUTES, FRAMES, Quantity, loosen
from sbi_active.mujoco.models.spec import mujoco_of

__all__ = [
    "ActuatorChange",
    "ContactChange",
    "GravityTilt",
    "Polynomial",
    "QuantityChange",
    "ZeroOffset",
]

Array = NDArray[Any]


@dataclass(frozen=True)
class QuantityChange(ModelChange):
    """Adds phi to a quantity of one element, or the same to that of several.

    Writes the fields of :mod:`.quantities`.
    """

    kind: str
    names: tuple[str, ...]
    attribute: str

    @override
    def fields(self) -> tuple[str, ...]:
        return FIELDS[self.kind, self.attribute]

    @override
    def write(self, model: Any, phi: Array) -> None:
        for name in self.names:
            i = 0 if self.kind == "option" else element_id(model, self.kind, name)
            for entry in ATTRIBUTES[self.kind][self.attribute](model, i):
                add_to(model, entry, float(phi[0]) * entry.factor)
            if self.attribute.startswith("com_") and phi[0]:
                loosen(model, name)


#: Fields of the quantities that effects change.
FIELDS = {
    ("joint", "damping"): ("dof_damping",),
    ("joint", "frictionloss"): ("dof_frictionloss",),
    ("joint", "armature"): ("dof_armature",),
    ("joint", "stiffness"): ("jnt_stiffness",),
    ("body", "mass"): ("body_mass", "body_inertia"),
    ("body", "com_x"): ("body_ipos", *FRAMES),
    ("body", "com_y"): ("body_ipos", *FRAMES),
    ("body", "com_z"): ("body_ipos", *FRAMES),
    ("option", "density"): ("opt.density",),
    ("option", "viscosity"): ("opt.viscosity",),
}


@dataclass(frozen=True)
class Polynomial(ModelChange):
    """Adds a power of the position or the speed to a joint's spring or damper.

    Writes ``dof_dampingpoly`` or ``jnt_stiffnesspoly``, of MuJoCo 3.7 or later.
    """

    names: tuple[str, ...]
    what: Literal["damping", "stiffness"]
    power: Literal[2, 3]

    @override
    def fields(self) -> tuple[str, ...]:
        return (
            ("dof_dampingpoly",) if self.what == "damping" else ("jnt_stiffnesspoly",)
        )

    @override
    def write(self, model: Any, phi: Array) -> None:
        for name in self.names:
            i = element_id(model, "joint", name)
            at = int(model.jnt_dofadr[i]) if self.what == "damping" else i
            add_to(model, Entry(self.fields()[0], (at, self.power - 2)), float(phi[0]))


@dataclass(frozen=True)
class ZeroOffset(ModelChange):
    """Moves the position at which a joint reads zero.

    At a reading q the joint is at q - phi: springs and stops stay where they are, and
    their readings move. Writes ``qpos0``, ``qpos_spring`` and ``jnt_range``.
    """

    names: tuple[str, ...]

    @override
    def fields(self) -> tuple[str, ...]:
        return "qpos0", "qpos_spring", "jnt_range"

    @override
    def write(self, model: Any, phi: Array) -> None:
        for name in self.names:
            i = element_id(model, "joint", name)
            at = int(model.jnt_qposadr[i])
            model.qpos0[at] += phi[0]
            model.qpos_spring[at] += phi[0]
            if model.jnt_limited[i]:
                model.jnt_range[i] += phi[0]


@dataclass(frozen=True)
class ActuatorChange(ModelChange):
    r"""Changes the law of actuators, :math:`F = g u + b_0 + b_1 l + b_2 \dot l`.

    A gain multiplies g and all b by :math:`1 + \phi`, a bias adds to :math:`b_0`,
    back-EMF takes phi from :math:`b_2`, and saturation limits F to :math:`\pm\phi`.
    Writes ``actuator_gainprm``, ``actuator_biasprm`` and ``actuator_biastype``, or
    ``actuator_forcelimited`` and ``actuator_forcerange``.
    """

    names: tuple[str, ...]
    what: Literal["gain", "bias", "back-EMF", "saturation"]

    @override
    def fields(self) -> tuple[str, ...]:
        if self.what == "saturation":
            return "actuator_forcelimited", "actuator_forcerange"
        if self.what == "gain":
            return "actuator_gainprm", "actuator_biasprm"
        return "actuator_biasprm", "actuator_biastype"

    @override
    def write(self, model: Any, phi: Array) -> None:
        value = float(phi[0])
        affine = int(mujoco_of().mjtBias.mjBIAS_AFFINE)
        for name in self.names:
            i = element_id(model, "actuator", name)
            if self.what == "gain":
                model.actuator_gainprm[i] *= 1 + value
                model.actuator_biasprm[i] *= 1 + value
            elif self.what == "saturation":
                if not np.isfinite(value):
                    continue
                low, high = model.actuator_forcerange[i]
                if not model.actuator_forcelimited[i]:
                    low, high = -np.inf, np.inf
                model.actuator_forcelimited[i] = 1
                model.actuator_forcerange[i] = max(low, -value), min(high, value)
            elif value:
                if int(model.actuator_biastype[i]) != affine:
                    model.actuator_biastype[i] = affine
                    model.actuator_biasprm[i, :3] = 0.0
                k, sign = (0, 1) if self.what == "bias" else (2, -1)
                model.actuator_biasprm[i, k] += sign * value


@dataclass(frozen=True)
class GravityTilt(ModelChange):
    """Turns gravity about a horizontal axis of the world. Writes ``opt.gravity``."""

    axis: Literal["x", "y"]

    @override
    def fields(self) -> tuple[str, ...]:
        return ("opt.gravity",)

    @override
    def write(self, model: Any, phi: Array) -> None:
        sine, cosine = np.sin(phi[0]), np.cos(phi[0])
        x, y, z = model.opt.gravity
        if self.axis == "x":
            turned = (x, cosine * y - sine * z, sine * y + cosine * z)
        else:
            turned = (cosine * x + sine * z, y, cosine * z - sine * x)
        model.opt.gravity[:] = turned


@dataclass(frozen=True)
class ContactChange(ModelChange):
    r"""Multiplies by :math:`e^\phi` how contacts rub, yield, or fail to damp.

    Friction is that of geoms and pairs; softness is the first number of ``solref``, a
    time constant; restitution divides the second, the damping ratio. Contacts whose
    ``solref`` is given as stiffness and damping are softened by dividing these. Writes
    ``geom_friction`` and ``pair_friction``, or ``geom_solref`` and ``pair_solref``.
    """

    what: Literal["friction", "softness", "restitution"]
    geoms: tuple[str, ...] | None = None

    @override
    def fields(self) -> tuple[str, ...]:
        field = "friction" if self.what == "friction" else "solref"
        return f"geom_{field}", f"pair_{field}"

    @override
    def write(self, model: Any, phi: Array) -> None:
        factor = float(np.exp(phi[0]))
        names = names_of(model, "geom") if self.geoms is None else self.geoms
        places = [element_id(model, "geom", name) for name in names]
        fields = [(field_of(model, self.fields()[0]), places)]
        if self.geoms is None:
            pairs = field_of(model, self.fields()[1])
            fields.append((pairs, [*range(len(pairs))]))
        for field, rows in fields:
            for i in rows:
                self._scale(field[i], factor)

    def _scale(self, values: Array, factor: float) -> None:
        if self.what == "friction":
            values *= factor
        elif values[0] <= 0:  # (-stiffness, -damping)
            values[0 if self.what == "softness" else 1] /= factor
        elif self.what == "softness":
            values[0] *= factor
        else:
            values[1] /= factor


def is_parameter(parameters: Any, change: QuantityChange) -> bool:
    """Return whether parameters have all that a change changes."""
    own = {p.quantity for p in parameters}
    wanted = {Quantity(change.kind, n, change.attribute) for n in change.names}
    return wanted <= own
