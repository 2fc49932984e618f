"""A simulator as bytes, whose functions keep the file that they were written in."""

from __future__ import annotations

import io
from collections import ChainMap
from collections.abc import Callable
from types import CodeType
from typing import Any, cast

import cloudpickle


def pickled(simulator: Callable[..., Any]) -> bytes:
    """Return the simulator as bytes, which ``cloudpickle.loads`` reads.

    Args:
        simulator: Any callable.

    Raises:
        TypeError: If it cannot be pickled.
    """
    buffer = io.BytesIO()
    try:
        _Pickler(buffer).dump(simulator)
    except Exception as error:
        raise TypeError(
            "expected a simulator that can travel to another process; got "
            f"{type(error).__name__}: {error}; open files and engines in the setup "
            "of a SimulatorModel, or run it here without workers="
        ) from error
    return buffer.getvalue()


def _reduced(code: CodeType) -> tuple[Any, ...]:
    rebuild, arguments, *_ = cloudpickle.CloudPickler.dispatch_table[CodeType](code)
    return _rebuilt, (code.co_filename, rebuild, arguments)


def _rebuilt(
    filename: str, rebuild: Callable[..., CodeType], arguments: tuple[Any, ...]
) -> CodeType:
    return rebuild(*arguments).replace(co_filename=filename)


class _Pickler(cloudpickle.CloudPickler):
    """Pickles code with the name of its file.

    From 3.1.3 on cloudpickle leaves it out, and a traceback from a worker would then
    show no line of the simulator.
    """

    # A view: what is registered with copyreg later counts as well.
    dispatch_table: Any = ChainMap(
        {CodeType: _reduced}, cast("dict", cloudpickle.CloudPickler.dispatch_table)
    )
