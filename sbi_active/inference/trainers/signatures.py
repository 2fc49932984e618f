"""Arguments of sbi's methods, taken as they are, and keywords of our own after them."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any


def extended(ours: Callable[..., Any], theirs: Callable[..., Any]) -> Any:
    """Return a method with the signature of sbi's, and keywords of its own after it."""

    @functools.wraps(ours)
    def call(*args: Any, **kwargs: Any) -> Any:
        return ours(*args, **kwargs)

    further = inspect.signature(ours).parameters.values()
    own = [p for p in further if p.kind is inspect.Parameter.KEYWORD_ONLY]
    known = inspect.signature(theirs).parameters.values()
    call.__signature__ = inspect.Signature([*known, *own])  # pyright: ignore
    return call


def given_arguments(
    method: Callable[..., Any], args: tuple[Any, ...], kwargs: Mapping[str, Any]
) -> dict[str, Any]:
    """Return by name the arguments that a call of a method of sbi's was given.

    None is left out where it is sbi's default, and is sbi's to refuse elsewhere.
    """
    signature = inspect.signature(method)
    given = signature.bind(*args, **kwargs).arguments
    defaults = signature.parameters
    return {
        name: value
        for name, value in given.items()
        if value is not None or defaults[name].default is not None
    }
