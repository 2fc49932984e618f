"""Objects of this library as bytes, and back, without executing any of it.

Pickle calls what a file names. Here torch's restricted reader makes numbers, texts,
containers and tensors, and otherwise calls the functions of ``CALLED`` alone: an object
is made of a class of this library, torch or sbi and its attributes. What a user wrote,
a simulator or a distribution of his own, is not stored but referred to by its name.
"""

from __future__ import annotations

import dataclasses
import pickle
import pkgutil
import zlib
from collections import OrderedDict
from collections.abc import Mapping
from contextlib import suppress
from contextvars import ContextVar
from io import BytesIO
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor, _utils

from sbi_active.inference.sampling.row_cache import RowCache
from sbi_active.messages import Explained, Message
from sbi_active.simulation.bank.store import GUARD

#: Packages whose classes are stored by their attributes.
TRUSTED = (
    *("sbi_active.", "sbi.utils.", "sbi.neural_nets."),
    *("torch.distributions.", "torch.nn.modules."),
)
#: Levels of attributes below what is given: the functions of a simulator's effects.
DEPTH = 4
#: Bytes that any file may hold, and times its size that it may hold beyond.
LEAST_LIMIT, MOST_SHRUNK = 16 * 2**20, 100

_KNOWN: ContextVar[Mapping[str, Any]] = ContextVar("known")


class NotStorableError(Explained, ValueError):
    """Something in an object is neither of this library nor given again."""

    code = "SA609"


class Absent:
    """Stands for what a reader does not have, and for whatever hangs from it."""


def made(name: str, state: Mapping[str, Any]) -> Any:
    """Return an object of a class and its attributes; its constructor is not called.

    Args:
        name: Class, as in "package.module:Class".
        state: Attributes; fields that came since have their defaults.
    """
    kind = _class(name)
    instance = object.__new__(kind)
    own, options = instance.__dict__, getattr(kind, "__attrs_attrs__", ())
    for entry in getattr(kind, "__dataclass_fields__", {}).values():
        if entry.default_factory is not dataclasses.MISSING:
            own[entry.name] = entry.default_factory()
    # All options have a default.
    own.update({entry.name: entry.default for entry in options}, **state)
    return instance


def given(name: str, *place: Any) -> Any:
    """Return what the reader gives by a name, or what hangs from it at a place."""
    thing = _KNOWN.get()[name]
    for step in place:
        thing = dict(_parts(thing)).get(step, Absent())
    return thing


def few(values: Any) -> Tensor:
    """Return a tensor of some numbers, which are read faster so."""
    return torch.tensor(values, dtype=torch.float32)


def numbers(tensor: Tensor) -> Any:
    """Return an array of numpy, or a number where it has no axis."""
    return tensor.numpy()[()]


#: What a file may have called, besides what torch makes tensors by.
CALLED = made, given, few, numbers, Message, set, frozenset
PLAIN = set, frozenset, OrderedDict, torch.Size, torch.dtype, torch.nn.Parameter
NAMED = {*CALLED, *PLAIN, *torch._storage_classes}
NAMED |= {_utils._rebuild_tensor_v2, _utils._rebuild_parameter}


def encode(value: Any, *, known: Mapping[str, Any]) -> bytes:
    """Return an object as bytes; one that occurs twice is stored once.

    Args:
        value: Numbers, texts, arrays, tensors, containers, and objects of this library,
            sbi's utilities and networks, torch's distributions and modules.
        known: Objects that the reader has too, by name, such as the simulator and the
            prior. They are stored by name; and what hangs from them, where it is the
            function of a simulator or of a class that is not stored, by its place.

    Raises:
        NotStorableError: If there is anything else in it.
    """
    places: dict[int, tuple[Any, ...]] = {}
    level: dict[tuple[Any, ...], Any] = {(name,): one for name, one in known.items()}
    for _ in range(DEPTH):
        places = {**{id(part): path for path, part in level.items()}, **places}
        level = {(*p, k): part for p, one in level.items() for k, part in _parts(one)}

    class Pickler(pickle.Pickler):
        def reducer_override(self, obj: Any) -> Any:
            kind, place = type(obj), places.get(id(obj), ())
            if len(place) == 1 or place[1:] == ("fn",):  # may hold compiled models
                return given, place
            if kind is Tensor and obj.dtype is torch.float32 and 0 < obj.numel() <= 16:
                return few, (obj.tolist(),)
            if kind is Tensor:  # without the rest of what it is a view of
                own = obj.detach().cpu().clone().requires_grad_(obj.requires_grad)
                return own.__reduce_ex__(2)
            if isinstance(obj, np.ndarray | np.generic) and obj.dtype.kind in "biufc":
                return numbers, (torch.from_numpy(np.array(obj, order="C")),)
            if kind is Message:
                return Message, (str(obj),)
            is_name = isinstance(obj, type | FunctionType) and obj in NAMED
            if is_name or kind in PLAIN:
                return NotImplemented
            name = f"{kind.__module__}:{kind.__qualname__}"
            if _class(name) is kind and hasattr(obj, "__dict__"):
                # What a cache lacks is simulated again.
                obj = RowCache(obj.most) if isinstance(obj, RowCache) else obj
                return made, (name, vars(obj))
            if place:
                return given, place
            raise NotStorableError(name)

    buffer, module = BytesIO(), SimpleNamespace(Pickler=Pickler, __name__=__name__)
    torch.save(value, buffer, pickle_module=module)
    return zlib.compress(buffer.getvalue(), 1)


def decode(content: bytes | None, *, known: Mapping[str, Any]) -> Any:
    """Return the object of :func:`encode`; None where there is nothing.

    Args:
        content: The bytes.
        known: Objects that were given to :func:`encode`, by the same names.

    Raises:
        ValueError: If the content is nothing that :func:`encode` writes.
    """
    if not content:
        return None
    # What was written shrinks less: a small file that fills memory was crafted.
    limit, reader = LEAST_LIMIT + MOST_SHRUNK * len(content), zlib.decompressobj()
    token = _KNOWN.set(known)
    try:
        plain = BytesIO(reader.decompress(content, limit))
        with GUARD:  # other checkpoints of the process may call no more than before
            allowed = {*CALLED} - {*torch.serialization.get_safe_globals()}
            with torch.serialization.safe_globals([*allowed]):
                return torch.load(plain, weights_only=True)
    except Exception as error:  # each library has its own
        text = f"expected what this library stores; got {type(error).__name__}"
        raise ValueError(f"{text}: {error!s:.60}; restore the file") from error
    finally:
        _KNOWN.reset(token)


def _parts(thing: Any) -> Any:
    """Return what hangs from a thing, by name or number."""
    is_list = isinstance(thing, list | tuple)
    return enumerate(thing) if is_list else getattr(thing, "__dict__", {}).items()


def _class(name: str) -> Any:
    """Return the class of a name, of a trusted module that defines it; else None."""
    module, _, qualname = name.partition(":")
    # Without a colon, resolve_name imports whatever it can, piece by piece.
    is_plain, found = bool(qualname) and "__main__" not in name, None
    if is_plain and module.startswith(TRUSTED):
        with suppress(AttributeError, ValueError):  # as of a class within a function
            found = pkgutil.resolve_name(name)
    return found if getattr(found, "__module__", None) == module else None
