"""Fingerprint of a simulator: its name, its settings and its source."""

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

from sbi_active.expected import require

#: Arrays up to this size are kept as numbers, so that a difference can be shown.
SMALL = 16

#: Deeper settings are not looked at: attributes of attributes, two levels each.
DEPTH = 12

#: This library, whose source changes from release to release; its tasks are machines.
OWN = tuple(f"sbi_active.{room}" for room in ("simulation", "mujoco", "criticism"))

#: Attributes of methods and of partial functions.
PARTS = "__func__", "__self__", "func", "args", "keywords"


def fingerprint(simulator: Callable[..., Any], *, version: str = "") -> dict[str, Any]:
    """Return a description of a simulator that can be stored and compared.

    It holds qualified names, source code (as a hash), and settings: public attributes,
    default arguments and captured variables. It does not see global variables, files,
    what a function calls, and what has no attributes; those are up to ``version``.

    Args:
        simulator: Any callable.
        version: Yours; where given, it stands for the source code, which may then
            change without the simulator being another.

    Returns:
        JSON data.
    """
    return {"version": version, "simulator": _describe(simulator, DEPTH)}


def require_same(
    what: str,
    before: Mapping[str, Any],
    now: Mapping[str, Any],
    part: str = "simulator",
) -> None:
    """Raise if the fingerprint of a simulator is not the one that was stored.

    Args:
        what: Words for what it was stored with.
        before: Fingerprint that was stored, among other data.
        now: Fingerprint of the simulator that is given.
        part: Word for it, where it is no simulator.

    Raises:
        ValueError: If they differ, with the differences.
    """
    lines = [*_differences(part, before["simulator"], now["simulator"])]
    if now["version"]:
        lines = [line for line in lines if ".source " not in line]
    if before["version"] != now["version"]:
        lines = [f"version {before['version']!r} there, {now['version']!r} here"]
    got, advice = f"another: {'; '.join(lines)}", "give the one that it was made with"
    if part == "simulator":
        advice += ", and its noise (--noise), or, where x is the same, the same "
        advice += "version= of a bank; a campaign takes another by "
        advice += "simulator_changed=True"
    require(not lines, f"the {part} of {what}", got, advice)


def _differences(path: str, before: Any, now: Any) -> Iterator[str]:
    if isinstance(before, dict) and isinstance(now, dict):
        # Keys of one side alone come from another release of a class.
        for key in sorted(before.keys() & now.keys()):
            yield from _differences(f"{path}.{key}", before[key], now[key])
    elif before != now and not (now is None and path.endswith(".source")):
        yield f"{path} {before!r} there, {now!r} here"


def _describe(value: Any, depth: int) -> Any:
    """Return JSON data for anything."""
    below = functools.partial(_describe, depth=depth - 1)
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu()
        value = (value.float() if value.dtype == torch.bfloat16 else value).numpy()
    if isinstance(value, np.ndarray) and value.size > SMALL:
        content = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
        return {"shape": [*value.shape], "dtype": str(value.dtype), "sha256": content}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float | complex | bytes):
        is_json = isinstance(value, float) and np.isfinite(value)
        return value if is_json else str(value)
    if isinstance(value, type) or depth == 0:
        return _name(value if isinstance(value, type) else type(value))
    if isinstance(value, list | tuple | set | frozenset):
        is_ordered = isinstance(value, list | tuple)
        return [
            below(item) for item in (value if is_ordered else sorted(value, key=repr))
        ]
    if isinstance(value, dict):
        return {str(key): below(item) for key, item in value.items()}
    if isinstance(value, types.FunctionType):
        captured = inspect.getclosurevars(value).nonlocals
        parts = {"captured": captured, "defaults": [*(value.__defaults__ or ())]}
        return {"name": _name(value), "source": _source(value), **below(parts)}
    # Methods and partial functions; others have their attributes, and a network more.
    parts = {name: getattr(value, name) for name in PARTS if hasattr(value, name)}
    parts |= getattr(value, "__dict__", {}) | getattr(value, "state_dict", dict)()
    public = {n: p for n, p in parts.items() if n in PARTS or n[0] != "_"}
    return {**below(public), "name": _name(type(value)), "source": _source(type(value))}


def _name(thing: Any) -> str:
    module = thing.__module__
    if module == "__main__":  # the same file, run and imported, is one simulator
        module = Path(getattr(sys.modules[module], "__file__", module)).stem
    return f"{module}.{thing.__qualname__}"


def _source(thing: Any) -> str | None:
    """Return a hash of the source code; this library's own classes are named only."""
    if (thing.__module__ or "").startswith(OWN):  # None in exec
        return None
    try:
        return hashlib.sha256(inspect.getsource(thing).encode()).hexdigest()[:16]
    except (OSError, TypeError):  # built in, or typed at a prompt
        return None
