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
from collections.abc import Mapping
from contextlib import suppress
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
            prior. It is stored by its name, and what hangs from it, where it is of a
            class that is not stored, by its place.

    Raises:
        NotStorableError: If there is anything else in it.
    """
    writer, buffer = _Writer(known), io.BytesIO()
    structure = json.dumps(writer.node(value), allow_nan=False)
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
    # What was written shrinks less: a small file that fills memory was crafted.
    limit, reader = LEAST_LIMIT + MOST_SHRUNK * len(content), zlib.decompressobj()
    try:
        plain = reader.decompress(content, limit)
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
        places = reversed(_places(known).items())  # the nearest last, which stays
        self._places = {id(value): path for path, value in places}
        self._seen: dict[int, tuple[int, Any]] = {}  # kept, as identities are of these

    def node(self, value: Any) -> Any:
        """Return a value as JSON."""
        kind, path = type(value), self._places.get(id(value), ())
        if kind in SCALARS:
            is_plain = not isinstance(value, float) or math.isfinite(value)
            return value if is_plain else {TAG: "float", "value": str(value)}
        if len(path) == 1:
            return {TAG: "known", "path": path}
        if id(value) in self._seen:
            return {TAG: "seen", "number": self._seen[id(value)][0]}
        self._seen[id(value)] = len(self._seen), value
        if kind in NAMES:
            items = value.items() if isinstance(value, dict) else [[v] for v in value]
            nodes = [[self.node(part) for part in item] for item in items]
            nodes = nodes if isinstance(value, dict) else [node for (node,) in nodes]
            return {TAG: NAMES[kind], "items": nodes}
        if isinstance(value, Tensor | np.ndarray | np.generic):
            return self._array(value)
        name = f"{kind.__module__}:{kind.__qualname__}"
        if _class(name) is not kind or not hasattr(value, "__dict__"):
            if not path:
                raise NotStorableError(name)
            return {TAG: "known", "path": path}
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
            array = np.array(value, order="C")
            if array.dtype.kind not in "biufc":
                raise NotStorableError(f"an array of {array.dtype}")
            kind = "array" if isinstance(value, np.ndarray) else "number"
            more = {"shape": [*array.shape], "dtype": array.dtype.str}
            stored = torch.from_numpy(array)
        self.arrays.append(stored)
        return {TAG: kind, "array": len(self.arrays) - 1, **more}


class _Reader:
    """Turns JSON back into values."""

    def __init__(self, known: Mapping[str, Any], arrays: list[Tensor]) -> None:
        self._places, self._arrays = _places(known), arrays
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
            return self._places[node["path"][0],]
        number = len(self._seen)
        # An object is there before its attributes, which may lead to it.
        self._seen.append(_blank(node["class"]) if kind == "object" else None)
        if kind == "object":
            for name, part in node["state"]:
                # Frozen dataclasses refuse to be changed, and modules look first.
                object.__setattr__(self._seen[number], name, self.value(part))
            if isinstance(self._seen[number], Diagnostics):  # messages were texts
                self._seen[number].__post_init__()
        else:
            self._seen[number] = self._whole(kind, node)
        return self._seen[number]

    def _whole(self, kind: str, node: dict[str, Any]) -> Any:
        """Return what is made at once of what it holds."""
        if kind == "known":
            return self._places.get((*node["path"],), Absent())
        if kind in KINDS and issubclass(KINDS[kind], dict):
            return KINDS[kind]([map(self.value, pair) for pair in node["items"]])
        if kind in KINDS:
            return KINDS[kind](map(self.value, node["items"]))
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


def _blank(name: str) -> Any:
    """Return what is filled later, with defaults of fields that came since."""
    found = _class(name)
    if not isinstance(found, type):
        raise TypeError(f"no class {name!r} that is stored")
    made = object.__new__(found)
    for entry in dataclasses.fields(found) if dataclasses.is_dataclass(found) else ():
        if entry.default_factory is not dataclasses.MISSING:
            object.__setattr__(made, entry.name, entry.default_factory())
    return made


def _places(known: Mapping[str, Any]) -> dict[tuple[Any, ...], Any]:
    """Return what is known, and what hangs from it, by place, the nearest first."""
    found: dict[tuple[Any, ...], Any] = {
        (name,): value for name, value in known.items()
    }
    level = dict(found)
    for _ in range(DEPTH):
        seen, below = {*map(id, found.values())}, {}
        for path, value in level.items():
            own = value if isinstance(value, dict) else getattr(value, "__dict__", {})
            parts: Any = [] if isinstance(value, type | Tensor) else own.items()
            parts = enumerate(value) if isinstance(value, list | tuple) else parts
            fresh = {n: p for n, p in parts if id(p) not in seen}
            below |= {(*path, n): p for n, p in fresh.items() if type(p) not in SCALARS}
        found |= (level := below)
    return found
