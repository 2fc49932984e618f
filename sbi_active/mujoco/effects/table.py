"""Rows of ``table.md``, and the effects that they make of elements."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch.distributions import Distribution, HalfNormal, Independent, Normal, Uniform

from sbi_active.criticism.effects.effect import Effect, UnderKey
from sbi_active.mujoco.effects.changes import (
    ActuatorChange,
    ContactChange,
    FrictionChange,
    GravityTilt,
    LateInput,
    Polynomial,
    PowerForce,
    QuantityChange,
    ReadingChange,
    ZeroOffset,
)
from sbi_active.mujoco.effects.elements import Element
from sbi_active.mujoco.effects.insertions import Transmission, least_compliance
from sbi_active.mujoco.models.changes import ModelChange
from sbi_active.mujoco.models.names import element_id

TABLE = Path(__file__).with_name("table.md")


@cache
def rows() -> tuple[Row, ...]:
    """Return the rows of the table."""
    lines = TABLE.read_text(encoding="utf-8").splitlines()
    cells = [line.split("|")[1:-1] for line in lines if line.startswith("|")]
    return tuple(Row(*(cell.strip() for cell in each)) for each in cells[2:])


@dataclass(frozen=True)
class Row:
    """An effect that elements of a kind may have; its columns are text.

    Attributes:
        kind: Kind of element.
        family: Family of the effect.
        what: Name of the effect, after the element's.
        changes: What it changes.
        prior: Prior of phi.
        unit: Unit of phi.
        sentence: Sentence for reports.
    """

    kind: str
    family: str
    what: str
    changes: str
    prior: str
    unit: str
    sentence: str

    def effect(self, element: Element) -> Effect | None:
        """Return the effect of an element, None where it has none."""
        change = _change(self.changes, element) if element.kind == self.kind else None
        if change is None:
            return None
        hook, apply = "dynamics", change
        if isinstance(change, ReadingChange | LateInput):
            hook = "observation" if isinstance(change, ReadingChange) else "input"
        else:
            keyword = "model" if isinstance(change, ModelChange) else "force"
            apply = UnderKey(keyword, change)
        has_unit = element.words or "{" not in self.unit
        return Effect(
            f"{element.label} {self.what}",
            hook=hook,
            prior=_prior(self.prior, element.sizes),
            null=torch.inf if self.prior.startswith("limit") else 0.0,
            apply=apply,
            units=self.unit.format(**element.words) if has_unit else "",
            family=self.family,
            describe=self.sentence.format(element.label, **element.words),
        )


def _prior(text: str, sizes: Mapping[str, float]) -> Distribution:
    """Return a prior, of as many numbers as there are commas and one."""
    kind, _, formulas = text.partition(" ")
    numbers = [_number(formula, sizes) for formula in formulas.split(",")]
    size = torch.tensor(numbers, dtype=torch.float64)
    if kind == "limit":
        return Independent(Uniform(size[:1], size[1:]), 1)
    if kind == "half":
        return Independent(HalfNormal(size), 1)
    return Independent(Normal(torch.zeros_like(size), size), 1)


def _number(formula: str, sizes: Mapping[str, float]) -> float:
    """Return the value of a product, as in "0.1 position / load^2"."""
    value = 1.0
    for slash, name, power in re.findall(r"(/?) *([\w.-]+)\^?(\d?)", formula):
        factor = (sizes[name] if name in sizes else float(name)) ** int(power or 1)
        value = value / factor if slash else value * factor
    return value


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
        case ["input", "delay" | "lag" as what]:
            return LateInput(names, what) if given["is_driven"] else None
        case ["reading", what]:
            return ReadingChange(given["channel"], what)  # pyright: ignore
        case ["tilt", "x" | "y" as axis]:
            return GravityTilt(axis)
        case ["contact", what]:
            return ContactChange(what, names)  # pyright: ignore
        case ["density" | "viscosity" as what]:
            return QuantityChange("option", names, what)
        case [power] if "^" in power:
            what, _, exponent = power.partition("^")
            return _power(names, given["model"], what, int(exponent))
        case [what]:
            if given.get("is_movable", True) or what == "mass":
                return QuantityChange(element.kind, names, what)
    return None


def _power(names: tuple[str, ...], model: Any, what: Any, power: int) -> Any:
    """Return a change with a power, a force where this MuJoCo has no field for it."""
    if hasattr(model, "dof_dampingpoly"):
        return Polynomial(names, what, power)
    places = []
    for name in names:
        i = element_id(model, "joint", name)
        place, dof = int(model.jnt_qposadr[i]), int(model.jnt_dofadr[i])
        places.append((place, dof, float(model.qpos_spring[place])))
    return PowerForce(tuple(places), what, power)


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
