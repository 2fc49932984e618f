"""Changes that effects make: what is written into which fields of a model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from typing_extensions import override

from sbi_active.arrays import Array
from sbi_active.mujoco.models.changes import ModelChange, StateChange
from sbi_active.mujoco.models.names import element_id
from sbi_active.mujoco.models.quantities import ATTRIBUTES, Quantity, add_to, field_of
from sbi_active.mujoco.models.spec import mujoco

ActuatorLaw = Literal["gain", "bias", "back-EMF", "saturation"]
ContactLaw = Literal["friction", "softness", "restitution"]


@dataclass(frozen=True)
class QuantityChange(ModelChange):
    """Adds phi to a quantity of one element, or the same to that of several."""

    kind: str
    names: tuple[str, ...]
    attribute: str

    @property
    def quantities(self) -> list[Quantity]:
        """Quantities that it changes."""
        return [Quantity(self.kind, name, self.attribute) for name in self.names]

    @override
    def fields(self) -> tuple[str, ...]:
        return ATTRIBUTES[self.kind][self.attribute].fields

    @override
    def write(self, model: Any, phi: Array) -> None:
        for quantity in self.quantities:
            for entry in quantity.entries(model):
                add_to(model, entry, float(phi[0]) * entry.factor)
            if phi[0]:
                quantity.loosen(model)


@dataclass(frozen=True)
class FrictionChange(StateChange):
    r"""Adds dry friction that follows the state of its joint.

    MuJoCo's own constraint holds the joint still below the friction of the moment,
    which no generalized force can do. Friction by position is larger towards either end
    of the range in which a joint moves,

    .. math::
        F = \phi_1 (1 - w)^2 + \phi_2 w^2, \qquad
        w = \mathrm{clip}\Bigl(\frac{q - q_{low}}{q_{high} - q_{low}}, 0, 1\Bigr),

    of which no part is constant, so that it is told from a plain friction loss; by
    load, of the actuators' force on the joint, :math:`F = \phi |\tau|`; or static
    (Stribeck), :math:`F = \phi e^{-|v| / v_s}`. No phi is negative, so that all of
    them dissipate. Writes ``dof_frictionloss`` before every step.

    Attributes:
        names: Names of the joints.
        what: Quantity that the friction follows.
        low: Lower end of each joint's range, rad or m.
        high: Upper end of each joint's range, rad or m.
        speed: :math:`v_s`, rad/s or m/s.
    """

    names: tuple[str, ...]
    what: Literal["position", "load", "speed"]
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    speed: float = 1.0

    @override
    def fields(self) -> tuple[str, ...]:
        return ("dof_frictionloss",)

    @override
    def joints(self) -> tuple[str, ...]:
        return self.names

    @override
    def values(self, q: Array, v: Array, load: Array, phi: Array) -> Array:
        if self.what == "load":
            return phi * np.abs(load)
        if self.what == "speed":
            return phi * np.exp(-np.abs(v) / self.speed)
        low, high = np.array(self.low), np.array(self.high)
        share = np.clip((q - low) / (high - low), 0.0, 1.0)
        return phi[:, :1] * (1 - share) ** 2 + phi[:, 1:] * share**2


@dataclass(frozen=True)
class ZeroOffset(ModelChange):
    """Moves the position at which a joint reads zero.

    At a reading q the joint is at q - phi: springs and stops stay where they are, and
    their readings move.
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
    """

    names: tuple[str, ...]
    what: ActuatorLaw

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
        affine = int(mujoco.mjtBias.mjBIAS_AFFINE)
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
    """Turns gravity about a horizontal axis of the world."""

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
    ``solref`` is given as stiffness and damping are softened by dividing these.

    Attributes:
        what: Quantity that is multiplied.
    """

    what: ContactLaw

    @override
    def fields(self) -> tuple[str, ...]:
        field = "friction" if self.what == "friction" else "solref"
        return f"geom_{field}", f"pair_{field}"

    @override
    def write(self, model: Any, phi: Array) -> None:
        factor = float(np.exp(phi[0]))
        for values in (row for name in self.fields() for row in field_of(model, name)):
            if self.what == "friction":
                values *= factor
            elif values[0] <= 0:  # (-stiffness, -damping)
                values[0 if self.what == "softness" else 1] /= factor
            elif self.what == "softness":
                values[0] *= factor
            else:
                values[1] /= factor
