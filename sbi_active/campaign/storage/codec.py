"""Objects of this library as plain data, and back, without executing any of it.

Pickle calls what a file names; here a file holds numbers and names, and an object is
made of a class of this library, torch or sbi and its attributes. What a user wrote, a
simulator or a distribution of his own, is not stored but referred to, and is put back
from where he gives it again.
"""

from __future__ import annotations

import dataclasses
import io
import json
import math
import pkgutil
import zlib
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import suppress
from types import MappingProxyType
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
SEQUENCES: dict[str, Any] = {
    **{kind.__name__: kind for kind in (list, tuple, set, frozenset)},
    "size": torch.Size,
}
MAPPINGS = {"dict": dict, "ordered": OrderedDict}
NAMES = {kind: name for name, kind in (SEQUENCES | MAPPINGS).items()}


class Absent:
    """Stands for what a reader does not have, and for whatever hangs from it."""


class NotStorableError(Explained, TypeError):
    """Something in an object is neither of this library nor given again."""

    code = "SA609"


def encode(value: Any, *, known: Mapping[str, Any]) -> bytes:
    """Return an object as bytes; one that occurs twice is stored once.

    Args:
        value: Numbers, texts, arrays, tensors, containers, and objects of this library,
            sbi's utilities and networks, torch's distributions and modules.
        known: Objects that the reader has too, by name, such as the simulator and the
            prior. It is stored by its name, and what hangs from it, where it is of a
            class that is not stored, by its place.

    Raises:
        NotStorableError: If there is anything else in it.
    """
    writer = _Writer(known)
    structure = json.dumps(writer.node(value), allow_nan=False)
    buffer = io.BytesIO()
    torch.save({"structure": structure, "arrays": writer.arrays}, buffer)
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
    try:
        # What was written shrinks less: a small file that fills memory was crafted.
        limit = LEAST_LIMIT + MOST_SHRUNK * len(content)
        reader = zlib.decompressobj()
        plain = reader.decompress(content, limit)
        if not reader.eof:
            raise ValueError(f"expected a whole file of {limit} bytes at most")
        stored = torch.load(io.BytesIO(plain), weights_only=True)
        return _Reader(known, stored["arrays"]).value(json.loads(stored["structure"]))
    except Exception as error:  # each library has its own
        raise ValueError(
            f"expected what this library stores; got {type(error).__name__}: "
            f"{str(error):.200}; restore the file from a copy"
        ) from error


class _Writer:
    """Turns values into JSON, and collects their arrays."""

    def __init__(self, known: Mapping[str, Any]) -> None:
        self.arrays: list[Tensor] = []
        self._places = {id(value): path for path, value in _places(known)}
        self._seen: dict[int, tuple[int, Any]] = {}  # kept, as identities are of these

    def node(self, value: Any) -> Any:
        """Return a value as JSON."""
        if type(value) in SCALARS:
            is_plain = not isinstance(value, float) or math.isfinite(value)
            return value if is_plain else {TAG: "float", "value": str(value)}
        path = self._places.get(id(value), ())
        if len(path) == 1:
            return {TAG: "known", "path": path}
        if id(value) in self._seen:
            return {TAG: "seen", "number": self._seen[id(value)][0]}
        self._seen[id(value)] = len(self._seen), value
        kind = NAMES.get(type(value), "")
        if kind in SEQUENCES:
            return {TAG: kind, "items": [self.node(item) for item in value]}
        if kind in MAPPINGS:
            pairs = [[self.node(k), self.node(v)] for k, v in value.items()]
            return {TAG: kind, "items": pairs}
        if isinstance(value, MappingProxyType):
            return {TAG: "proxy", "of": self.node({**value})}
        if isinstance(value, torch.dtype | torch.device):
            name = str(value).removeprefix("torch.")
            return {TAG: type(value).__name__, "name": name}
        if isinstance(value, Tensor | np.ndarray | np.generic):
            return self._array(value)
        kind = type(value)
        name = f"{kind.__module__}:{kind.__qualname__}"
        if _class(name) is not kind or not hasattr(value, "__dict__"):
            if path:
                return {TAG: "known", "path": path}
            raise NotStorableError(f"{kind.__module__}.{kind.__qualname__}")
        if isinstance(value, RowCache):  # what it lacks is simulated again
            value = RowCache(value.most)
        state = [[name, self.node(part)] for name, part in vars(value).items()]
        return {TAG: "object", "class": name, "state": state}

    def _array(self, value: Any) -> Any:
        if isinstance(value, Tensor):
            kind = "parameter" if isinstance(value, torch.nn.Parameter) else "tensor"
            more: dict[str, Any] = {"gradient": value.requires_grad}
            stored = value.detach().cpu().clone()
        else:
            array = np.ascontiguousarray(value)
            if array.dtype.kind not in "biufc":
                raise NotStorableError(f"an array of {array.dtype}")
            kind = "array" if isinstance(value, np.ndarray) else "number"
            more = {"shape": [*np.shape(value)], "dtype": array.dtype.str}
            stored = torch.from_numpy(array.copy())
        self.arrays.append(stored)
        return {TAG: kind, "array": len(self.arrays) - 1, **more}


class _Reader:
    """Turns JSON back into values."""

    def __init__(self, known: Mapping[str, Any], arrays: list[Tensor]) -> None:
        self._known, self._arrays = known, arrays
        self._seen: list[Any] = []

    def value(self, node: Any) -> Any:
        """Return the value that a node stands for."""
        if not isinstance(node, dict):
            return node
        kind = node[TAG]
        if kind == "float":
            return float(node["value"])
        if kind == "seen":
            return self._seen[node["number"]]
        if kind == "known" and len(node["path"]) == 1:  # not counted by the writer
            return self._known[node["path"][0]]
        number = len(self._seen)
        made: Any = _blank(kind, node)
        self._seen.append(made)  # before what it holds, which may be itself
        if kind in MAPPINGS:
            made.update((self.value(k), self.value(v)) for k, v in node["items"])
        elif kind == "list":
            made.extend(self.value(item) for item in node["items"])
        elif kind == "object":
            for name, part in node["state"]:
                # Frozen dataclasses refuse to be changed, and modules look first.
                object.__setattr__(made, name, self.value(part))
            if isinstance(made, Diagnostics):  # whose messages are stored as texts
                made.__post_init__()
        else:
            made = self._seen[number] = self._whole(kind, node)
        return made

    def _whole(self, kind: str, node: dict[str, Any]) -> Any:
        """Return what cannot contain itself."""
        if kind == "known":
            return _at(self._known, node["path"])
        if kind in SEQUENCES:
            return SEQUENCES[kind]([self.value(item) for item in node["items"]])
        if kind == "proxy":
            return MappingProxyType(self.value(node["of"]))
        if kind == "dtype":
            found = getattr(torch, node["name"])
            if not isinstance(found, torch.dtype):
                raise TypeError(f"no dtype {node['name']!r}")
            return found
        if kind == "device":
            return torch.device(node["name"])
        tensor = self._arrays[node["array"]]
        if kind == "parameter":
            return torch.nn.Parameter(tensor, requires_grad=node["gradient"])
        if kind == "tensor":
            return tensor.requires_grad_(node["gradient"])
        array = tensor.numpy().astype(np.dtype(node["dtype"])).reshape(node["shape"])
        return array if kind == "array" else array[()]


def _class(name: str) -> Any:
    """Return the class of a name, of a trusted module that defines it; else None."""
    module = name.partition(":")[0]
    if not module.startswith(TRUSTED) or module.endswith("__main__"):
        return None
    found: Any = None
    with suppress(AttributeError, ValueError):  # as of a class within a function
        found = pkgutil.resolve_name(name)
    return found if getattr(found, "__module__", None) == module else None


def _blank(kind: str, node: Mapping[str, Any]) -> Any:
    """Return what is filled later; of an object with defaults of fields added since."""
    if kind != "object":
        return MAPPINGS.get(kind, list)()
    found = _class(node["class"])
    if not isinstance(found, type):
        raise TypeError(f"no class {node['class']!r} that is stored")
    made = object.__new__(found)
    for entry in dataclasses.fields(found) if dataclasses.is_dataclass(found) else ():
        if entry.default_factory is not dataclasses.MISSING:
            object.__setattr__(made, entry.name, entry.default_factory())
    return made


def _places(known: Mapping[str, Any]) -> Iterator[tuple[list[Any], Any]]:
    """Yield what is known, and where each object below it hangs, the nearest first."""
    level: list[tuple[list[Any], Any]] = [([n], value) for n, value in known.items()]
    seen = {id(value) for _, value in level}
    yield from level
    for _ in range(DEPTH):
        below = ((p, n, part) for p, value in level for n, part in _parts(value))
        level = []
        for path, name, part in below:
            if type(part) not in SCALARS and id(part) not in seen:
                seen.add(id(part))
                level.append(([*path, name], part))
        yield from level


def _parts(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield what hangs from an object: attributes by name, items by number or key."""
    if isinstance(value, list | tuple):
        yield from enumerate(value)
    elif isinstance(value, dict):
        yield from ((k, v) for k, v in value.items() if isinstance(k, str))
    elif not isinstance(value, type | Tensor | np.ndarray):
        yield from getattr(value, "__dict__", {}).items()


def _at(known: Mapping[str, Any], path: list[Any]) -> Any:
    found: Any = known[path[0]]
    for name in path[1:]:
        if isinstance(found, Absent):
            return found
        found = dict(_parts(found))[name]
    return found
