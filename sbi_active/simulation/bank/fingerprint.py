"""Fingerprint of a simulator: its name, its settings and its source."""

from __future__ import annotations

import ast
import functools
import hashlib
import inspect
import sys
import textwrap
import types
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

#: Arrays up to this size are kept as numbers, so that a difference can be shown.
SMALL = 16

#: Deeper settings are not looked at.
DEPTH = 6

#: Methods that change a container or an array; torch's end in an underscore.
CHANGING = {
    *("add", "append", "appendleft", "clear", "discard", "extend", "fill", "insert"),
    *("pop", "popitem", "popleft", "put", "remove", "resize", "reverse", "setdefault"),
    *("sort", "update"),
}


def fingerprint(simulator: Callable[..., Any], *, version: str = "") -> dict[str, Any]:
    """Return a description of a simulator that can be stored and compared.

    It holds qualified names, source code (as a hash), and settings: public attributes,
    default arguments, captured variables, and the global variables that the simulator's
    functions name, in their own module or imported by ``from ... import``: numbers,
    texts, arrays, containers of these, and functions of the same module, with those
    that they name. It does not see files, what is read as an attribute of a module
    (``settings.g``), functions and classes of other modules, objects of a user's
    classes, and what a function itself changes, such as counters and caches; those
    are up to ``version``.

    Args:
        simulator: Any callable.
        version: Yours; where given, it stands for the source code, which may then
            change without the simulator being another.

    Returns:
        JSON data.
    """
    return {"version": version, "simulator": _describe(simulator, DEPTH)}


def differences(expected: Mapping[str, Any], got: Mapping[str, Any]) -> list[str]:
    """Return the differences of two fingerprints, one line each; none if they agree."""
    if expected["version"] != got["version"]:
        return [f"version {expected['version']!r} there, {got['version']!r} here"]
    lines = _compare("simulator", expected["simulator"], got["simulator"])
    return [line for line in lines if not (got["version"] and ".source " in line)]


def simulator_name(identity: Mapping[str, Any]) -> str:
    """Return the name of a simulator, and of the function that it wraps."""
    simulator = identity["simulator"]
    if not isinstance(simulator, dict):  # a class is described by its name
        return str(simulator)
    inner = simulator.get("fn", simulator.get("function"))
    names = [d.get("name") for d in (simulator, inner) if isinstance(d, dict)]
    return " of ".join(str(name) for name in names if name)


def _compare(path: str, expected: Any, got: Any) -> Iterator[str]:
    if isinstance(expected, dict) and isinstance(got, dict):
        # Keys of one side alone come from another release of a class.
        for key in sorted(expected.keys() & got.keys()):
            yield from _compare(f"{path}.{key}", expected[key], got[key])
    elif expected != got:
        yield f"{path} {expected!r} there, {got!r} here"


def _describe(value: Any, depth: int) -> Any:
    """Return JSON data for anything."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if np.isfinite(value) else str(value)
    if _is_array(value):
        return _array(value)
    if isinstance(value, type):
        return _name(value)
    if depth == 0:
        return _name(type(value))
    below = functools.partial(_describe, depth=depth - 1)
    if isinstance(value, list | tuple):
        return [below(item) for item in value]
    if isinstance(value, dict):
        return {str(key): below(item) for key, item in value.items()}
    if isinstance(value, complex | bytes | set | frozenset):
        parts = value if isinstance(value, set | frozenset) else [value]
        return sorted(map(repr, parts))
    if isinstance(value, functools.partial):
        return {
            "function": below(value.func),
            "arguments": below([*value.args]),
            "keywords": below(value.keywords),
        }
    if isinstance(value, types.MethodType):
        return {"function": below(value.__func__), "self": below(value.__self__)}
    if isinstance(value, types.FunctionType):
        cells = zip(value.__code__.co_freevars, value.__closure__ or (), strict=True)
        is_empty = types.CellType()
        captured = {n: cell.cell_contents for n, cell in cells if cell != is_empty}
        return {
            "name": _name(value),
            "source": _source(value),
            "captured": below(captured),
            "defaults": below([*(value.__defaults__ or ())]),
            "globals": _globals([value]),
        }
    if isinstance(value, torch.nn.Module):
        return {"name": _name(type(value)), "state": below(dict(value.state_dict()))}
    settings = getattr(value, "__dict__", {}).items()  # else it has slots, or is of C
    own = {"name": _name(type(value)), "source": _source(type(value))}
    if callable(value):
        module = type(value).__module__
        kinds = [kind for kind in type(value).__mro__ if kind.__module__ == module]
        methods = [m for k in kinds for m in vars(k).values() if inspect.isfunction(m)]
        own["globals"] = _globals(methods)
    public = {name: below(item) for name, item in settings if name[0] != "_"}
    return {**public, **own}


def _is_array(value: Any) -> bool:
    if isinstance(value, torch.Tensor):
        return value.device.type != "meta" and value.layout == torch.strided
    return isinstance(value, np.ndarray) and value.dtype.kind in "biufcSU"


def _array(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu()
        value = (value.float() if value.dtype == torch.bfloat16 else value).numpy()
    if value.size <= SMALL and value.dtype.kind in "iufb":
        return _describe(value.tolist(), DEPTH)
    content = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
    return {"shape": [*value.shape], "dtype": str(value.dtype), "sha256": content}


def _is_setting(value: Any) -> bool:
    """Return whether a global variable is a setting: numbers, texts, many of them."""
    if isinstance(value, dict):
        value = [*value.values()]
    if isinstance(value, list | tuple | set | frozenset):
        return all(map(_is_setting, value))
    scalars = bool | int | float | complex | str | bytes | np.generic
    return value is None or isinstance(value, scalars) or _is_array(value)


def _globals(functions: list[types.FunctionType]) -> dict[str, Any]:
    """Return the global variables that functions use, from function to function.

    Args:
        functions: Functions to begin with; those that they name are added.
    """
    found: dict[str, Any] = {}
    functions = [function for function in functions if not _is_library(function)]
    for function in functions:
        changed = _changed_by(function)
        for name in _names_in(function.__code__) & function.__globals__.keys():
            value = function.__globals__[name]
            value = getattr(value, "__wrapped__", value)  # of a cache
            if isinstance(value, types.FunctionType):
                if value.__module__ == function.__module__ and value not in functions:
                    functions.append(value)
                    defaults = _describe([*(value.__defaults__ or ())], DEPTH)
                    found[name] = {"source": _source(value), "defaults": defaults}
            elif name not in changed and name[:2] != "__" and _is_setting(value):
                found[name] = _describe(value, DEPTH)
    return found


def _names_in(code: types.CodeType) -> set[str]:
    """Return the names that code uses, that of inner functions too."""
    inner = (c for c in code.co_consts if isinstance(c, types.CodeType))
    return {*code.co_names}.union(*map(_names_in, inner))


def _changed_by(function: types.FunctionType) -> set[str]:
    """Return names of what a function changes: counters, caches, buffers."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    except (OSError, TypeError, SyntaxError):  # typed at a prompt, or a part of a line
        return set()
    places: list[Any] = []
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Global):
            names |= {*node.names}
        elif isinstance(node, ast.Subscript) and not isinstance(node.ctx, ast.Load):
            places.append(node)
        elif isinstance(node, ast.Attribute) and (
            node.attr in CHANGING or node.attr.endswith("_")
        ):
            places.append(node.value)
    for place in places:
        while isinstance(place, ast.Subscript):  # as in CACHE["a"].append
            place = place.value
        names.add(getattr(place, "id", ""))
    return names


def _name(thing: Any) -> str:
    module = thing.__module__
    if module == "__main__":  # the same file, run and imported, is one simulator
        main = sys.modules["__main__"]
        spec = getattr(main, "__spec__", None)  # of python -m
        module = spec.name if spec else Path(getattr(main, "__file__", module)).stem
    return f"{module}.{thing.__qualname__}"


def _source(thing: Any) -> str | None:
    """Return a hash of the source code; this library's own classes are named only."""
    if (thing.__module__ or "").startswith("sbi_active.simulation"):  # None in exec
        return None
    try:
        return hashlib.sha256(inspect.getsource(thing).encode()).hexdigest()[:16]
    except (OSError, TypeError):  # built in, or typed at a prompt
        return None


def _is_library(thing: Any) -> bool:
    """Return whether this library's releases say what it is, and no user."""
    module = thing.__module__ or ""
    return module.startswith("sbi_active.") and "tasks" not in module
