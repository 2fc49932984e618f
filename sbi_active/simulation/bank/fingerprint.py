"""What tells one simulator from another: its name, its settings and its source."""

from __future__ import annotations

import functools
import hashlib
import inspect
import sys
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


def fingerprint(simulator: Callable[..., Any], *, version: str = "") -> dict[str, Any]:
    """Return a description of a simulator that can be stored and compared.

    It holds qualified names, source code (as a hash), and settings: public attributes,
    default arguments and captured variables. It does not see the files, modules and
    global variables that the simulator uses; those are up to ``version``.

    Args:
        simulator: Any callable.
        version: Yours; where given, it stands for the source code, which may then
            change without the simulator being another.

    Returns:
        JSON data.
    """
    return {"version": version, "simulator": _describe(simulator, DEPTH)}


def differences(expected: Mapping[str, Any], got: Mapping[str, Any]) -> list[str]:
    """Return where two fingerprints differ, one line each; none for one simulator."""
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
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if np.isfinite(value) else str(value)
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
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
    if isinstance(value, functools.partial):
        return {
            "function": below(value.func),
            "arguments": below([*value.args]),
            "keywords": below(value.keywords),
        }
    if isinstance(value, types.MethodType):
        return {"function": below(value.__func__), "self": below(value.__self__)}
    if isinstance(value, types.FunctionType):
        return {
            "name": _name(value),
            "source": _source(value),
            "captured": below(_captured(value)),
            "defaults": below([*(value.__defaults__ or ())]),
        }
    if isinstance(value, torch.nn.Module):
        return {"name": _name(type(value)), "state": below(dict(value.state_dict()))}
    settings = {k: v for k, v in _attributes(value).items() if not k.startswith("_")}
    own = {"name": _name(type(value)), "source": _source(type(value))}
    return {**{key: below(item) for key, item in settings.items()}, **own}


def _attributes(value: Any) -> dict[str, Any]:
    """Return attributes; those without a dictionary have slots or are written in C."""
    return getattr(value, "__dict__", {})


def _array(array: np.ndarray) -> Any:
    if array.size <= SMALL and array.dtype.kind in "iufb":
        return _describe(array.tolist(), DEPTH)
    content = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
    return {"shape": [*array.shape], "dtype": str(array.dtype), "sha256": content}


def _captured(function: types.FunctionType) -> dict[str, Any]:
    captured = {}
    for name, cell in zip(
        function.__code__.co_freevars, function.__closure__ or (), strict=True
    ):
        try:
            captured[name] = cell.cell_contents
        except ValueError:  # not assigned yet
            captured[name] = None
    return captured


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
