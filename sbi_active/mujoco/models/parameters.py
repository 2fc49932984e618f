r"""Parameters of a model: numbers with bounds, and how they get into ``mjModel``.

A parameter that names a quantity is written into its fields. One that edits the spec is
compiled a few times instead, to see which numbers of ``mjModel`` it changes; where they
are affine in all parameters together,

.. math::
    f_i(\theta) = c_i + \sum_j A_{ij} \theta_j,

at places that were not used to find c and A, these are written from then on. Otherwise
every distinct theta is compiled.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sbi_active.mujoco.models.fields import Entry, field_of, set_to
from sbi_active.mujoco.models.quantities import (
    FRAMES,
    NEVER_NEGATIVE,
    Quantity,
    find_quantity,
    is_movable,
    loosen,
)
from sbi_active.mujoco.models.spec import mujoco_of

__all__ = ["Bounded", "Writer", "bounded", "renew", "writer_of"]

Array = NDArray[Any]

#: Relative error of a number that is taken for affine, beside compiling.
AFFINE = 1e-9
#: Places at which that is tried.
NUM_TRIED = 4
#: Relative size below which a coefficient is rounding.
ROUNDING = 1e-11
#: What ``mj_setConst`` makes of the other fields.
DERIVED = (
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "dof_M0",
    "dof_length",
    "tendon_length0",
    "tendon_invweight0",
    "actuator_acc0",
    "actuator_length0",
    "stat.",
)


@dataclass(frozen=True)
class Bounded:
    """A parameter of a model.

    Attributes:
        name: Name in reports.
        low: Lowest value.
        high: Highest value.
        unit: Unit of the values.
        quantity: Quantity whose value it is; None if it edits the spec.
        edit: ``edit(spec, value)`` before the model is compiled; None for a quantity.
    """

    name: str
    low: float
    high: float
    unit: str = ""
    quantity: Quantity | None = None
    edit: Callable[[Any, float], Any] | None = None


class Writer(Protocol):
    """Puts parameters into models of one shape.

    Attributes:
        fields: Names of those that it writes.
    """

    fields: tuple[str, ...]

    def model(self, theta: Array) -> Any | None:
        """Return a model of its own for parameters (d,), None if it writes them."""
        ...

    def write(self, model: Any, theta: Array) -> None:
        """Write parameters (d,) into a model whose fields are as compiled."""
        ...


def bounded(model: Any, parameters: Mapping[str, Any]) -> tuple[Bounded, ...]:
    """Return parameters as users declare them.

    Args:
        model: Compiled model, to find quantities and units.
        parameters: Parameters by name: (low, high) of the quantity of that name; (low,
            high, "element.attribute") under a name of one's own; or (low, high, edit)
            with a function ``edit(spec, value)``.

    Raises:
        ValueError: If there is none, bounds are not in order, or a name is unknown.
    """
    if not parameters:
        raise ValueError(
            "expected at least one parameter; got none; pass parameters={'joint."
            "damping': (low, high)}"
        )
    found = []
    for name, given in parameters.items():
        try:
            low, high, *rest = given
            low, high = float(low), float(high)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"expected parameter {name!r} as (low, high), or (low, high, quantity "
                f"or function of the spec); got {given!r}; pass its bounds"
            ) from error
        if not (np.isfinite([low, high]).all() and low < high) or len(rest) > 1:
            raise ValueError(
                f"expected finite bounds low < high of parameter {name!r}; got "
                f"{given!r}; pass them in this order"
            )
        if rest and callable(rest[0]):
            found.append(Bounded(name, low, high, edit=rest[0]))
            continue
        quantity = find_quantity(model, rest[0] if rest else name)
        if quantity.attribute in NEVER_NEGATIVE and low < 0:
            raise ValueError(
                f"expected bounds of {str(quantity)!r} from 0 on; got {low:g} to "
                f"{high:g}; raise the lower one"
            )
        if quantity.attribute.startswith("com_"):
            _require_movable(model, quantity.name)
        unit = quantity.unit(model)
        found.append(Bounded(name, low, high, unit, quantity))
    return tuple(found)


def _require_movable(model: Any, body: str) -> None:
    if not is_movable(model, body):
        raise ValueError(
            f"expected a body whose center of mass can be written; got {body!r}, which "
            "MuJoCo compiles as simple; give it simple='false' in the MJCF"
        )


def writer_of(
    spec: Callable[[], Any],
    model: Any,
    parameters: Sequence[Bounded],
    *,
    edit: Callable[[Any, Array], Any] | None = None,
    text: Callable[[], Any] | None = None,
) -> Writer:
    """Return the writer of parameters into a model.

    Args:
        spec: Function that returns a spec that compiles to the model.
        model: Compiled model.
        parameters: Parameters in the order of theta.
        edit: ``edit(spec, theta)`` of all parameters at once, in place of theirs.
        text: Function that returns a spec as another process has it, for parameters
            that are compiled there; None takes ``spec``.
    """
    if edit is None and all(p.edit is None for p in parameters):
        quantities = [p.quantity for p in parameters if p.quantity is not None]
        return _Quantities(quantities, model)

    def compiled(theta: Array, source: Callable[[], Any] = spec) -> Any:
        edited = source()
        if edit is not None:
            edit(edited, theta)
        for parameter, value in zip(parameters, theta, strict=True):
            if parameter.edit is not None:
                parameter.edit(edited, float(value))
        changed = edited.compile()
        for parameter, value in zip(parameters, theta, strict=True):
            if parameter.quantity is not None:
                for entry in parameter.quantity.entries(changed):
                    set_to(changed, entry, float(value) * entry.factor)
                if parameter.quantity.attribute.startswith("com_"):
                    loosen(changed, parameter.quantity.name)
        renew(changed, mujoco_of().MjData(changed))
        return changed

    low = np.array([p.low for p in parameters])
    high = np.array([p.high for p in parameters])
    found = _affine(compiled, low, high)
    return found or _Compiled(partial(compiled, source=text or spec))


def renew(model: Any, data: Any) -> None:
    """Compute again what follows from masses, inertias and gears, in place.

    MuJoCo does not renew the mean inertia, by which its solver knows when to stop.

    Args:
        model: Model that was written into.
        data: Data of such a model, to work in.
    """
    mean = float(model.dof_M0.mean()) if model.nv else 0.0
    is_own = abs(model.stat.meaninertia - mean) <= AFFINE * mean
    mujoco_of().mj_setConst(model, data)
    if model.nv and is_own:  # and not given in the MJCF
        model.stat.meaninertia = float(model.dof_M0.mean())


class _Quantities:
    """Writes each parameter into the numbers that follow its quantity."""

    def __init__(self, quantities: Sequence[Quantity], model: Any) -> None:
        self.entries = [q.entries(model) for q in quantities]
        self.moved = [q.name for q in quantities if q.attribute.startswith("com_")]
        fields = {e.field: None for each in self.entries for e in each}
        self.fields = (*fields, *(FRAMES if self.moved else ()))

    def model(self, theta: Array) -> None:
        return None

    def write(self, model: Any, theta: Array) -> None:
        for each, value in zip(self.entries, theta.tolist(), strict=True):
            for entry in each:
                set_to(model, entry, value * entry.factor)
        for body in self.moved:
            loosen(model, body)


class _Affine:
    """Writes numbers that are affine in the parameters."""

    def __init__(self, parts: Mapping[str, tuple[Array, Array, Array]]) -> None:
        self.parts = dict(parts)  # by field: flat places, c, A
        self.fields = tuple(parts)

    def model(self, theta: Array) -> None:
        return None

    def write(self, model: Any, theta: Array) -> None:
        for name, (places, constant, slope) in self.parts.items():
            values = constant + slope @ theta
            field = field_of(model, name)
            if isinstance(field, np.ndarray):
                field.reshape(-1)[places] = values
            else:
                set_to(model, Entry(name, ()), float(values[0]))


class _Compiled:
    """Compiles every theta."""

    fields = ()

    def __init__(self, compiled: Callable[[Array], Any]) -> None:
        self._compiled = compiled

    def model(self, theta: Array) -> Any:
        return self._compiled(theta)

    def write(self, model: Any, theta: Array) -> None:
        """Nothing is left to write."""


def _affine(
    compiled: Callable[[Array], Any], low: Array, high: Array
) -> _Affine | None:
    """Return the writer of affine numbers, None if some are not."""
    middle, half = 0.5 * (low + high), 0.25 * (high - low)
    base = _numbers(compiled(middle))
    steps = []
    for j in range(len(low)):
        unit = np.eye(len(low))[j] * half
        steps.append((_numbers(compiled(middle + unit)), 2 * half[j]))
        steps[-1] += (_numbers(compiled(middle - unit)),)
    if any({*s[0]} != {*base} for s in steps):
        return None
    parts = {}
    for name, value in base.items():
        every = [value, *[s[0][name] for s in steps], *[s[2][name] for s in steps]]
        if any(v.shape != value.shape for v in every):
            return None
        moved = np.any([v != value for v in every], 0)
        if not moved.any() or name.startswith(DERIVED):
            continue
        places = np.flatnonzero(moved)
        slope = np.stack(
            [(up[name] - down[name])[places] / width for up, width, down in steps], -1
        )
        scale = np.abs(slope).max() or 1.0
        slope = np.where(np.abs(slope) < ROUNDING * scale, 0.0, slope)
        rounded = np.round(slope, 12)
        slope = np.where(np.abs(slope - rounded) <= ROUNDING * scale, rounded, slope)
        constant = value[places] - slope @ middle
        size = np.abs(value[places]) + np.abs(slope) @ np.abs(middle)
        constant = np.where(np.abs(constant) <= ROUNDING * size, 0.0, constant)
        parts[name] = places, constant, slope
    found = _Affine(parts)
    return found if _agrees(found, compiled, low, high) else None


def _agrees(
    writer: _Affine, compiled: Callable[[Array], Any], low: Array, high: Array
) -> bool:
    """Compare with compiling at places that were not used."""
    mujoco = mujoco_of()
    model = compiled(0.5 * (low + high))
    rng = np.random.default_rng(0)
    for _ in range(NUM_TRIED):
        theta = rng.uniform(low, high)
        writer.write(model, theta)
        renew(model, mujoco.MjData(model))
        here, there = _numbers(model), _numbers(compiled(theta))
        for name, value in there.items():
            # What is computed from masses keeps fewer digits.
            allowed = AFFINE * (np.abs(value).max() if value.size else 0.0)
            if not np.allclose(here[name], value, rtol=AFFINE, atol=allowed):
                return False
    return True


def _numbers(model: Any) -> dict[str, Array]:
    """Return all numeric fields of a model, flat, by name."""
    found = {}
    for owner, before in ((model, ""), (model.opt, "opt.")):
        for name in dir(owner):
            if name.startswith("_"):
                continue
            value = getattr(owner, name)
            if isinstance(value, np.ndarray) and value.dtype.kind in "fiu":
                found[before + name] = value.astype(float).reshape(-1).copy()
            elif before and isinstance(value, int | float):
                found[before + name] = np.array([float(value)])
    found["stat.meaninertia"] = np.array([model.stat.meaninertia])
    return found
