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

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from sbi_active.arrays import Array
from sbi_active.expected import require
from sbi_active.mujoco.models.quantities import (
    FRAMES,
    Quantity,
    field_of,
    find_quantity,
    is_movable,
    set_field,
)
from sbi_active.mujoco.models.spec import mujoco

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

    def __post_init__(self) -> None:
        expected = f"finite bounds low < high of parameter {self.name!r}"
        in_order = (
            bool(np.isfinite([self.low, self.high]).all()) and self.low < self.high
        )
        got = f"{self.low:g} and {self.high:g}"
        require(in_order, expected, got, "pass them in this order")


@dataclass(frozen=True)
class Writer:
    """Puts parameters into models of one shape.

    Attributes:
        parts: Numbers that are affine in the parameters: by field their flat places,
            c and A.
        compiled: Function that compiles a model for parameters (d,), where some are not
            affine; None where all are.
    """

    parts: Mapping[str, tuple[Array, Array, Array]] = field(default_factory=dict)
    compiled: Callable[[Array], Any] | None = None

    def write(self, model: Any, theta: Array) -> None:
        """Write parameters (d,) into a model whose fields are as compiled."""
        for name, (places, constant, slope) in self.parts.items():
            values = constant + slope @ theta
            now = np.array(field_of(model, name))
            now.reshape(-1)[places] = values
            set_field(model, name, now)


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
    advice = "pass parameters={'joint.damping': (low, high)}"
    require(bool(parameters), "at least one parameter", "none", advice)
    found = []
    for name, given in parameters.items():
        is_pair = np.shape(given) in ((2,), (3,))
        require(is_pair, f"(low, high) of parameter {name!r}", given, advice)
        low, high, what = given if len(given) == 3 else (*given, name)
        low, high = float(low), float(high)
        if callable(what):
            found.append(Bounded(name, low, high, edit=what))
            continue
        quantity = find_quantity(model, what)
        require(
            low >= 0 or quantity.known.is_signed,
            f"bounds of {str(quantity)!r} from 0 on",
            f"{low:g} to {high:g}",
            "raise the lower one",
        )
        require(
            not quantity.is_center or is_movable(model, quantity.name),
            "a body whose center of mass can be written",
            f"{quantity.name!r}, which MuJoCo compiles as simple",
            "give it simple='false' in the MJCF",
        )
        found.append(Bounded(name, low, high, quantity.unit(model), quantity))
    return tuple(found)


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
        return _of_quantities(parameters, model)

    def compiled(theta: Array, source: Callable[[], Any] = spec) -> Any:
        edited = source()
        if edit is not None:
            edit(edited, theta)
        for parameter, value in zip(parameters, theta, strict=True):
            if parameter.edit is not None:
                parameter.edit(edited, float(value))
        changed = edited.compile()
        _of_quantities(parameters, changed).write(changed, theta)
        renew(changed, mujoco.MjData(changed))
        return changed

    low = np.array([p.low for p in parameters])
    high = np.array([p.high for p in parameters])
    found = _affine(compiled, low, high)
    if found is not None and _agrees(found, compiled, low, high):
        return found
    return Writer(compiled=partial(compiled, source=text or spec))


def renew(model: Any, data: Any) -> None:
    """Compute again what follows from masses, inertias and gears, in place.

    MuJoCo does not renew the mean inertia, by which its solver knows when to stop.

    Args:
        model: Model that was written into.
        data: Data of such a model, to work in.
    """
    mean = float(model.dof_M0.mean()) if model.nv else 0.0
    is_own = abs(model.stat.meaninertia - mean) <= 1e-9 * mean
    mujoco.mj_setConst(model, data)
    if model.nv and is_own:  # and not given in the MJCF
        model.stat.meaninertia = float(model.dof_M0.mean())


def _of_quantities(parameters: Sequence[Bounded], model: Any) -> Writer:
    """Return the writer of those parameters that are quantities of a model."""
    num = len(parameters)
    slopes: dict[str, dict[int, Array]] = {}
    quantities = [p.quantity for p in parameters]
    for j, quantity in enumerate(quantities):
        for entry in quantity.entries(model) if quantity else []:
            shape = np.shape(field_of(model, entry.field))
            place = int(np.ravel_multi_index(entry.index, shape)) if shape else 0
            slopes.setdefault(entry.field, {})[place] = entry.factor * np.eye(num)[j]
    parts = {
        name: (np.array([*own]), np.zeros(len(own)), np.array([*own.values()]))
        for name, own in slopes.items()
    }
    loose = copy.copy(model)
    for quantity in filter(None, quantities):
        quantity.loosen(loose)
    for name in FRAMES:
        frames = field_of(loose, name)
        places = np.flatnonzero(frames != field_of(model, name))
        if len(places):
            parts[name] = places, frames[places] + 0.0, np.zeros((len(places), num))
    return Writer(parts)


def _affine(
    compiled: Callable[[Array], Any],
    low: Array,
    high: Array,
    *,
    rounding: float = 1e-11,
) -> Writer | None:
    """Return the writer of affine numbers, None if numbers come or go.

    Args:
        compiled: Function that compiles a model for parameters.
        low: Lowest parameters.
        high: Highest parameters.
        rounding: Relative size below which a coefficient counts as rounding. A
            thousand times the precision of floats, and a hundredth of what
            :func:`_agrees` sees.
    """
    middle, half = 0.5 * (low + high), 0.25 * (high - low)
    base = _numbers(compiled(middle))
    units = np.diag(half)
    ups = [_numbers(compiled(middle + unit)) for unit in units]
    downs = [_numbers(compiled(middle - unit)) for unit in units]
    parts = {}
    for name, value in base.items():
        every = [numbers.get(name) for numbers in (*ups, *downs)]
        if any(v is None or v.shape != value.shape for v in every):
            return None
        moved = np.any([v != value for v in every], 0)
        if not moved.any() or name.startswith(DERIVED):
            continue
        places = np.flatnonzero(moved)
        differences = [
            up[name] - down[name] for up, down in zip(ups, downs, strict=True)
        ]
        slope = np.stack(differences, -1)[places] / (2 * half)
        rounded = np.round(slope, 12)  # of 0 and 1, which most slopes are
        close = np.abs(slope - rounded) <= rounding * (np.abs(slope).max() or 1.0)
        slope = np.where(close, rounded, slope)
        constant = value[places] - slope @ middle
        size = np.abs(value[places]) + np.abs(slope) @ np.abs(middle)
        constant = np.where(np.abs(constant) <= rounding * size, 0.0, constant)
        parts[name] = places, constant, slope
    return Writer(parts)


def _agrees(
    writer: Writer,
    compiled: Callable[[Array], Any],
    low: Array,
    high: Array,
    *,
    places: int = 4,
    tolerance: float = 1e-9,
) -> bool:
    """Compare with compiling at places that were not used.

    Args:
        writer: Writer to judge.
        compiled: Function that compiles a model for parameters.
        low: Lowest parameters.
        high: Highest parameters.
        places: Number of places. What is not affine fails at the first.
        tolerance: Relative error of numbers that are alike; compiling keeps about 12
            digits.
    """
    model = compiled(0.5 * (low + high))
    rng = np.random.default_rng(0)
    for _ in range(places):
        theta = rng.uniform(low, high)
        writer.write(model, theta)
        renew(model, mujoco.MjData(model))
        here, there = _numbers(model), _numbers(compiled(theta))
        for name, value in there.items():
            if np.array_equal(here[name], value):  # most are, and need no tolerance
                continue
            # What is computed from masses keeps fewer digits.
            allowed = tolerance * (np.abs(value).max() if value.size else 0.0)
            if not np.allclose(here[name], value, rtol=tolerance, atol=allowed):
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
