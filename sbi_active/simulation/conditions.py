"""Arguments of a simulator's function, and conditions of a trial beyond its action.

A function ``fn(theta, action)`` may take any of ``times``, shape (n, k), at which x is
measured; ``inputs``, {name: (n, m)}, over time; ``input_times``, (m,), their uniform
grid; and ``start``, the measured start states, {name: (n,)}.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.actions.mixed import MixedActions
from sbi_active.actions.signals import SignalActions

#: Names of these arguments.
CONDITIONS = ("times", "inputs", "input_times", "start")


def parameters_of(fn: Callable[..., Any]) -> list[inspect.Parameter]:
    """Return the arguments of a function, none where it has no signature."""
    try:
        return [*inspect.signature(fn).parameters.values()]
    except (TypeError, ValueError):  # builtins and C functions have no signature
        return []


def keywords_of(fn: Callable[..., Any], num_rows: int) -> list[str]:
    """Return names of the keyword arguments behind so many positional ones."""
    kinds, parameters = inspect.Parameter, parameters_of(fn)
    named = kinds.POSITIONAL_OR_KEYWORD, kinds.KEYWORD_ONLY
    positional = [p for p in parameters if p.kind != kinds.KEYWORD_ONLY][:num_rows]
    return [p.name for p in parameters if p.kind in named and p not in positional]


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
    """Return float64 arrays in place of tensors, and numbers as NumPy's."""
    return changed(value, lambda v: np.asarray(v, dtype=np.float64)[()])
