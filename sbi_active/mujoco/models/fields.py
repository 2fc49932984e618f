"""Numbers of a model that are written in place: fields of ``mjModel`` by name."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

__all__ = ["Entry", "add_to", "copied", "field_of", "restore", "set_to"]


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
    if entry.index:
        field_of(model, entry.field)[entry.index] = value
        return
    *owner, name = entry.field.split(".")
    setattr(field_of(model, ".".join(owner)) if owner else model, name, value)


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
