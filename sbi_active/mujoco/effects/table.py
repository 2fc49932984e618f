"""Rows of ``table.md``, and the effects that they make of elements."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sbi_active.criticism.effects.changes import Wrapped
from sbi_active.criticism.effects.effect import Effect, UnderKey
from sbi_active.criticism.effects.table import rows_of
from sbi_active.mujoco.effects.changes import (
    ActuatorChange,
    ContactChange,
    FrictionChange,
    GravityTilt,
    QuantityChange,
    ZeroOffset,
)
from sbi_active.mujoco.effects.elements import Element
from sbi_active.mujoco.effects.insertions import Transmission, least_compliance
from sbi_active.mujoco.models.changes import ModelChange
from sbi_active.mujoco.models.names import element_id

TABLE = Path(__file__).with_name("table.md")


def effects_of(element: Element) -> list[Effect]:
    """Return the effects of an element."""
    found = []
    for row in rows_of(TABLE):
        change = _change(row.changes, element) if row.of == element.kind else None
        if change is None:
            continue
        hook, apply = "dynamics", change
        if isinstance(change, Wrapped):
            hook = "input" if change.inputs else "observation"
        else:
            keyword = "model" if isinstance(change, ModelChange) else "force"
            apply = UnderKey(keyword, change)
        made = row.made(hook, apply, element.label, element.sizes, element.words)
        found.append(made)
    return found


def _change(changes: str, element: Element) -> Any:
    """Return what an effect changes, None where the element has no such thing."""
    names, given = element.names, element.given
    match changes.split():
        case ["friction", "by", "position"]:
            low, high = given["low"], given["high"]
            if all(a < b for a, b in zip(low, high, strict=True)):
                return FrictionChange(names, "position", low, high)
        case ["friction", "by", "load"]:
            return FrictionChange(names, "load")
        case ["friction", "by", "speed"]:
            return FrictionChange(names, "speed", speed=given["speed"])
        case ["play" | "spring" as kind]:
            return _transmission(names, given, is_spring=kind == "spring")
        case ["zero"]:
            return ZeroOffset(names)
        case ["gain" | "bias" | "back-EMF" | "saturation" as what]:
            return ActuatorChange(names, what)
        case ["input", "delay" | "lag"]:
            return Wrapped(changes, names) if given["is_driven"] else None
        case ["reading", what]:
            return Wrapped(what, channel=given["channel"])
        case ["tilt", "x" | "y" as axis]:
            return GravityTilt(axis)
        case ["contact", what]:
            return ContactChange(what)  # pyright: ignore
        case ["density" | "viscosity" as what]:
            return QuantityChange("option", names, what)
        case [what]:
            is_there = "^" not in what or hasattr(given["model"], "dof_dampingpoly")
            if is_there and (what == "mass" or given.get("is_movable", True)):
                return QuantityChange(element.kind, names, what)
    return None


def _transmission(
    names: tuple[str, ...], given: Mapping[str, Any], *, is_spring: bool
) -> Transmission | None:
    """Return play or a spring behind joints, None unless each is alone in its body."""
    if "behind" not in given:
        return None
    model, least = given["model"], given["play"]
    step = float(model.opt.timestep)
    if is_spring:
        dofs = [model.jnt_dofadr[element_id(model, "joint", name)] for name in names]
        least = max(
            least_compliance(inertia, float(model.dof_armature[dof]), step)
            for inertia, dof in zip(given["behind"], dofs, strict=True)
        )
    return Transmission(names, is_spring, given["behind"], step, least)
