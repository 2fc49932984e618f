"""Arguments of a simulator's function, read from its signature."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any


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
