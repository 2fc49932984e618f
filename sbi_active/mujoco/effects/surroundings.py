"""Effects of bodies and of what surrounds them: payload, gravity, medium, contacts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from sbi_active.criticism.effects.effect import Effect
from sbi_active.mujoco.effects.acting import half_normal, model_effect, normal
from sbi_active.mujoco.effects.nominal import Nominal
from sbi_active.mujoco.effects.ties import Group
from sbi_active.mujoco.effects.writing import (
    ContactChange,
    GravityTilt,
    QuantityChange,
)
from sbi_active.mujoco.models.names import element_id, names_of
from sbi_active.mujoco.models.quantities import is_movable

__all__ = ["of_bodies", "of_contacts", "of_surroundings"]

#: Payload as a share of a body's mass, center of mass as one of its radius of gyration.
PAYLOAD, CENTER = 0.2, 0.2
TILT = 0.05  # rad
#: Density and viscosity of air at sea level.
DENSITY, VISCOSITY = 1.2, 1.8e-5
#: Logarithms of factors of contacts.
FRICTION, SOFTNESS, RESTITUTION = 0.3, 0.5, 0.7
#: Geoms up to which contacts are offered one by one.
FEW_GEOMS = 6


def of_bodies(group: Group, sizes: Nominal) -> Iterator[Effect]:
    """Yield the effects of bodies that share each phi, or of one."""
    model = sizes.model
    first = group.names[0]
    i = element_id(model, "body", first)
    mass = float(model.body_mass[i])
    radius = float(np.sqrt(model.body_inertia[i].sum() / (2 * mass)))
    yield model_effect(
        f"{group.label} payload",
        QuantityChange("body", group.names, "mass"),
        prior=half_normal(PAYLOAD * mass),
        units="kg",
        family="inertia",
        describe=f"{group.label} carries a mass spread like its own",
    )
    if len(group.names) > 1 or not is_movable(model, first):
        return  # the axes of symmetric bodies need not be mirrored alike
    for axis in ("x", "y", "z"):
        yield model_effect(
            f"{group.label} center of mass {axis}",
            QuantityChange("body", group.names, f"com_{axis}"),
            prior=normal(CENTER * radius),
            units="m",
            family="inertia",
            describe=f"the center of mass of {group.label} is elsewhere along {axis}",
        )


def of_surroundings(sizes: Nominal) -> Iterator[Effect]:
    """Yield the effects of gravity and of the medium."""
    for axis in ("x", "y"):
        yield model_effect(
            f"gravity tilt {axis}",
            GravityTilt(axis),
            prior=normal(TILT),
            units="rad",
            family="surroundings",
            describe=f"the base is tilted about {axis}",
        )
    for name, sd, unit in (
        ("density", DENSITY, "kg/m^3"),
        ("viscosity", VISCOSITY, "Pa s"),
    ):
        yield model_effect(
            f"medium {name}",
            QuantityChange("option", ("option",), name),
            prior=half_normal(sd),
            units=unit,
            family="surroundings",
            describe=f"the bodies move through a medium with {name}",
        )


def of_contacts(sizes: Nominal) -> Iterator[Effect]:
    """Yield the effects of contacts, of all and of a few geoms one by one."""
    model: Any = sizes.model
    if not sizes.has_contacts:
        return
    touching = [
        name
        for i, name in enumerate(names_of(model, "geom"))
        if model.geom_contype[i] or model.geom_conaffinity[i]
    ]
    groups: list[tuple[str, tuple[str, ...] | None]] = [("contact", None)]
    if 1 < len(touching) <= FEW_GEOMS:
        groups += [(name, (name,)) for name in touching]
    for label, names in groups:
        kinds: Any = (
            ("friction", normal(FRICTION), "rubs by a factor of exp(phi)"),
            ("softness", normal(SOFTNESS), "yields for longer by a factor of exp(phi)"),
            (
                "restitution",
                half_normal(RESTITUTION),
                "is damped less by a factor of exp(phi)",
            ),
        )
        for what, prior, words in kinds:
            yield model_effect(
                f"{label} {what}",
                ContactChange(what, names),
                prior=prior,
                family="contact",
                describe=f"{'every contact' if names is None else label} {words}",
            )
