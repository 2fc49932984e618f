"""Objects of this library as plain data, and back, without executing any of it.

Pickle calls what a file names; here a file holds numbers and names, and an object is
made of a class of this library, torch or sbi and its attributes. What a user wrote, a
simulator or a distribution of his own, is not stored but referred to, and is put back
from where he gives it again.
"""

from __future__ import annotations

import dataclasses
import json
import pkgutil
import zlib
from collections import OrderedDict
from collections.abc import Mapping
from contextlib import suppress
from io import BytesIO
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sbi_active.inference.beliefs.diagnostics import Diagnostics
from sbi_active.inference.sampling.row_cache import RowCache
from sbi_active.messages import Explained, Message

#: Packages whose classes are stored by their attributes.
TRUSTED = (
    *("sbi_active.", "sbi.utils.", "sbi.neural_nets."),
    *("torch.distributions.", "torch.nn.modules."),
)
#: Levels of attributes below what is given again in which to look for references.
DEPTH = 5
#: Bytes that any file may hold, and times its size that it may hold beyond.
LEAST_LIMIT, MOST_SHRUNK = 16 * 2**20, 100
TAG = "!"  # of whatever JSON does not hold by itself
SCALARS = (type(None), bool, int, float, str, Message)
KINDS: dict[str, Any] = {
    **{kind.__name__: kind for kind in (list, tuple, set, frozenset, dict)},
    **{"size": torch.Size, "ordered": OrderedDict},
}
NAMES = {kind: name for name, kind in KINDS.items()}


class NotStorableError(Explained, ValueError):
    """Something in an object is neither of this library nor given again."""

    code = "SA609"


class Absent:
    """Stands for what a reader does not have, and for whatever hangs from it."""


def encode(value: Any, *, known: Mapping[str, Any]) -> bytes:
    """Return an object as bytes; one that occurs twice is stored once.

    Args:
        value: Numbers, texts, arrays, tensors, containers, and objects of this library,
            sbi's utilities and networks, torch's distributions and modules.
        known: Objects that the reader has too, by name, such as the simulator and the
            prior. It is stored by its name, and what hangs from it, where it is the
            function of a simulator or of a class that is not stored, by its place.

    Raises:
        NotStorableError: If there is anything else in it.
    """
    # The nearest place comes last, and stays.
    places = {id(part): path for path, part in reversed(_places(known).items())}
    seen: dict[int, tuple[int, Any]] = {}  # kept, as identities are of these
    arrays: list[Tensor] = []

    def node(value: Any) -> Any:
        kind, path = type(value), places.get(id(value), ())
        if kind in SCALARS:
            return value
        if len(path) == 1:
            return {TAG: "known", "path": path}
        if id(value) in seen:
            return {TAG: "seen", "number": seen[id(value)][0]}
        seen[id(value)] = len(seen), value
        if path[1:] == ("fn",):  # may hold compiled models, which nothing stores
            return {TAG: "known", "path": path}
        if issubclass(kind, dict) and kind in NAMES:
            pairs = [[node(name), node(part)] for name, part in value.items()]
            return {TAG: NAMES[kind], "items": pairs}
        if kind in NAMES:
            return {TAG: NAMES[kind], "items": [*map(node, value)]}
        if isinstance(value, Tensor):
            arrays.append(value.detach().cpu().clone())
            name = "parameter" if isinstance(value, torch.nn.Parameter) else "tensor"
            more: Any = {"gradient": value.requires_grad}
            return {TAG: name, "array": len(arrays) - 1, **more}
        if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biufc":
            array = np.array(value, order="C")
            arrays.append(torch.from_numpy(array))
            name = "array" if isinstance(value, np.ndarray) else "number"
            more = {"shape": [*array.shape], "dtype": array.dtype.str}
            return {TAG: name, "array": len(arrays) - 1, **more}
        name = f"{kind.__module__}:{kind.__qualname__}"
        if _class(name) is kind and hasattr(value, "__dict__"):
            # What a cache lacks is simulated again.
            value = RowCache(value.most) if isinstance(value, RowCache) else value
            state = [[name, node(part)] for name, part in vars(value).items()]
            return {TAG: "object", "class": name, "state": state}
        if not path:
            raise NotStorableError(name)
        return {TAG: "known", "path": path}

    structure, buffer = json.dumps(node(value)), BytesIO()
    torch.save({"structure": structure, "arrays": arrays}, buffer)
    return zlib.compress(buffer.getvalue(), 1)


def decode(content: bytes, *, known: Mapping[str, Any]) -> Any:
    """Return the object of :func:`encode`.

    Nothing in the content is executed: tensors are read by torch's restricted reader,
    and objects are made without calling their constructors.

    Args:
        content: The bytes.
        known: Objects that were given to :func:`encode`, by the same names.

    Raises:
        ValueError: If the content is nothing that :func:`encode` writes.
    """
    # What was written shrinks less: a small file that fills memory was crafted.
    limit, reader = LEAST_LIMIT + MOST_SHRUNK * len(content), zlib.decompressobj()
    try:
        plain = BytesIO(reader.decompress(content, limit))
        stored = torch.load(plain, weights_only=True)
        return _read(json.loads(stored["structure"]), known, stored["arrays"])
    except Exception as error:  # each library has its own
        raise ValueError(
            f"expected what this library stores; got {type(error).__name__}: "
            f"{str(error):.200}; restore the file from a copy"
        ) from error


def _read(structure: Any, known: Mapping[str, Any], arrays: list[Tensor]) -> Any:
    places, seen = _places(known), []

    def value(node: Any) -> Any:
        if not isinstance(node, dict):
            return node
        kind = node[TAG]
        if kind == "float":  # not finite, as release 0.1 wrote it
            return float(node["value"])
        if kind == "seen":
            return seen[node["number"]]
        if kind == "known" and len(node["path"]) == 1:  # not counted
            return places[node["path"][0],]
        number = len(seen)
        # An object is there before its attributes, which may lead to it.
        seen.append(_blank(node["class"]) if kind == "object" else None)
        if kind != "object":
            seen[number] = whole(kind, node)
        for name, part in node.get("state", ()):
            # Frozen dataclasses refuse to be changed, and modules look first.
            object.__setattr__(seen[number], name, value(part))
        if isinstance(seen[number], Diagnostics):  # messages were texts
            seen[number].__post_init__()
        return seen[number]

    def whole(kind: str, node: dict[str, Any]) -> Any:
        if kind == "known":
            return places.get((*node["path"],), Absent())
        if kind in ("dict", "ordered"):
            return KINDS[kind]([map(value, pair) for pair in node["items"]])
        if kind in KINDS:
            return KINDS[kind](map(value, node["items"]))
        tensor = arrays[node["array"]]
        if kind == "parameter":
            return torch.nn.Parameter(tensor, requires_grad=node["gradient"])
        if kind == "tensor":
            return tensor.requires_grad_(node["gradient"])
        array = tensor.numpy().astype(np.dtype(node["dtype"])).reshape(node["shape"])
        return array if kind == "array" else array[()]

    return value(structure)


def _class(name: str) -> Any:
    """Return the class of a name, of a trusted module that defines it; else None."""
    module, found = name.partition(":")[0], None
    if module.startswith(TRUSTED) and not module.endswith("__main__"):
        with suppress(AttributeError, ValueError):  # as of a class within a function
            found = pkgutil.resolve_name(name)
    return found if getattr(found, "__module__", None) == module else None


def _blank(name: str) -> Any:
    """Return what is filled later, with defaults of fields that came since."""
    found = _class(name)
    if not isinstance(found, type):
        raise TypeError(f"no class {name!r} that is stored")
    made = object.__new__(found)
    for entry in getattr(found, "__dataclass_fields__", {}).values():
        if entry.default_factory is not dataclasses.MISSING:
            object.__setattr__(made, entry.name, entry.default_factory())
    return made


def _places(known: Mapping[str, Any]) -> dict[tuple[Any, ...], Any]:
    """Return what is known, and what hangs from it, by place, the nearest first."""
    level: dict[tuple[Any, ...], Any] = {(name,): part for name, part in known.items()}
    found = {**level}
    for _ in range(DEPTH):
        seen, below = {*map(id, found.values())}, {}
        for path, value in level.items():
            parts = value if isinstance(value, dict) else getattr(value, "__dict__", {})
            parts = dict(enumerate(value)) if isinstance(value, list | tuple) else parts
            parts = {} if isinstance(value, type | Tensor) else parts
            for name, part in parts.items():
                if type(part) not in SCALARS and id(part) not in seen:
                    below[(*path, name)] = part
        found |= (level := below)
    return found
