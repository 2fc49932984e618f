"""Arguments of a simulator's function, and conditions of a trial beyond its action.

A function ``fn(theta, action)`` may take any of ``times``, shape (n, k), at which x is
measured; ``inputs``, {name: (n, m)}, over time; ``input_times``, (m,), their uniform
grid; and ``start``, the measured start states, (n, d) or {name: (n,)}.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.actions.mixed import MixedActions
from sbi_active.actions.signals import SignalActions

#: Names of these arguments.
CONDITIONS = ("times", "inputs", "input_times", "start")
#: What gives each of them.
SOURCES = {
    "times": "SimulatorModel(sample_times=...) or Trials(sample_times=...)",
    "inputs": "Trials(inputs=...)",
    "input_times": "Trials(inputs=..., input_times=...)",
    "start": "Trials(start=...)",
}


def parameters_of(fn: Callable[..., Any]) -> list[inspect.Parameter]:
    """Return the arguments of a function, none where it has no signature."""
    try:
        return [*inspect.signature(fn).parameters.values()]
    except (TypeError, ValueError):  # builtins and C functions have no signature
        return []


def keywords_of(fn: Callable[..., Any], num_rows: int) -> tuple[list[str], bool]:
    """Return names of keyword arguments behind the positional ones, and if any go."""
    parameters = parameters_of(fn)
    kinds = inspect.Parameter
    named = kinds.POSITIONAL_OR_KEYWORD, kinds.KEYWORD_ONLY
    positional = [p for p in parameters if p.kind != kinds.KEYWORD_ONLY][:num_rows]
    names = [p.name for p in parameters if p.kind in named and p not in positional]
    return names, any(p.kind == kinds.VAR_KEYWORD for p in parameters)


def takes_rng(fn: Callable[..., Any]) -> bool:
    """Return whether a function of one row takes a third argument, its generator."""
    parameters = parameters_of(fn)
    kinds = inspect.Parameter
    if any(p.kind == kinds.VAR_POSITIONAL for p in parameters) or not parameters:
        return True
    behind = [p for p in parameters if p.kind < kinds.VAR_POSITIONAL][2:3]
    return any(
        p.name != "context" and not isinstance(p.default, int | float) for p in behind
    )


def conditions_of(
    fn: Callable[..., Any], keywords: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the conditions that a function takes, and those that it requires.

    A condition that a ``functools.partial`` binds does not count.

    Args:
        fn: The function.
        keywords: Names of its keyword arguments.
    """
    bound = getattr(inspect.unwrap(fn), "keywords", {})
    takes = tuple(c for c in CONDITIONS if c in keywords and c not in bound)
    if not takes:
        return (), ()
    parameters = inspect.signature(fn).parameters
    none = inspect.Parameter.empty
    return takes, tuple(c for c in takes if parameters[c].default is none)


def require_conditions(needed: tuple[str, ...], given: Mapping[str, Any]) -> None:
    """Raise if a function lacks a condition that it requires."""
    for name in needed:
        if name not in given:
            raise ValueError(
                f"expected {name} for a simulator whose function requires it; got "
                f"none; pass {SOURCES[name]}, or give the argument a default"
            )


def require_taken(
    inputs: SignalActions | MixedActions | None, conditions: tuple[str, ...]
) -> None:
    """Raise if signals are given that a function does not take."""
    if inputs is not None and "inputs" not in conditions:
        raise ValueError(
            "expected a function that takes the signals of its actions; got one "
            "without an argument 'inputs'; write fn(theta, action, *, inputs)"
        )


def played(
    space: SignalActions | MixedActions, action: Tensor, dtype: torch.dtype
) -> dict[str, Any]:
    """Return the signals of actions as inputs and input_times.

    Args:
        space: Space of the actions.
        action: Actions, shape (n, action_dim); equal ones are generated once.
        dtype: Type of the series.
    """
    each, place = torch.unique(action, dim=0, return_inverse=True)
    return {
        "inputs": {
            name: series[place].to(dtype) for name, series in space.inputs(each).items()
        },
        "input_times": space.input_times.to(dtype),
    }


def require_rows_each(name: str, value: Any, num: int) -> None:
    """Raise if a keyword argument is neither a number nor one a row."""
    if isinstance(value, Mapping):
        for key, part in value.items():
            require_rows_each(f"{name}[{key!r}]", part, num)
    elif name != "input_times" and np.ndim(value) and len(value) != num:
        raise ValueError(
            f"expected {name} as a number or one a row, shape ({num}, ...); got "
            f"{tuple(np.shape(value))}; repeat it for each row"
        )


def changed(value: Any, change: Callable[[Any], Any]) -> Any:
    """Return a value with a change, which is that of each part of a dict.

    Args:
        value: Value of a keyword argument.
        change: Function of what is no dict.
    """
    if isinstance(value, Mapping):
        return {name: changed(part, change) for name, part in value.items()}
    return change(value)


def at_rows(keywords: Mapping[str, Any], at: Any) -> dict[str, Any]:
    """Return keyword arguments of some rows; numbers belong to all."""
    return {
        name: value
        if name == "input_times"
        else changed(value, lambda v: v[at] if np.ndim(v) else v)
        for name, value in keywords.items()
    }


def typed(value: Any, dtype: torch.dtype) -> Any:
    """Return tensors in a type, those of a dict too; None stays None."""
    return changed(value, lambda v: None if v is None else v.to(dtype))


def copied(value: Any) -> Any:
    """Return arrays that a function may change; a number is what it is."""

    def own(part: Any) -> Any:
        if isinstance(part, Tensor):
            return part.clone()
        return part.copy() if isinstance(part, np.ndarray) else part

    return changed(value, own)


def as_arrays(value: Any) -> Any:
    """Return keyword arguments with float64 arrays in place of tensors and numbers."""
    return changed(value, lambda v: np.asarray(v, dtype=np.float64))


def one_row(arrays: Mapping[str, Any], i: int) -> dict[str, Any]:
    """Return the keyword arguments of a row, from those of all, as copies of its own.

    Args:
        arrays: Arrays from :func:`as_arrays`.
        i: Index of the row.
    """

    def own(value: Any) -> Any:
        is_number = isinstance(value, np.ndarray) and not value.ndim
        return float(value) if is_number else value

    return changed(copied(at_rows(arrays, i)), own)
