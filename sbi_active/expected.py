"""Arguments of public classes and functions: checked, suggested and shown alike."""

from __future__ import annotations

import difflib
import functools
import inspect
import operator
from collections.abc import Callable, Iterable, Sequence
from numbers import Real
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from attrs import Attribute

Taking = TypeVar("Taking", bound=Callable[..., Any])
#: What attrs calls with an instance, the attribute and its value.
Validator = Callable[[Any, "Attribute[Any]", Any], None]


def require(holds: bool, expected: str, got: Any, advice: str) -> None:
    """Raise if a setting is not what it has to be.

    Args:
        holds: Whether it is.
        expected: Name and range of the setting.
        got: Value that was given.
        advice: Advice on what to do.

    Raises:
        ValueError: If it does not hold, with all three in its text.

    Example:
        >>> require(False, "num_rows >= 1", 0, "use some thousand")
        Traceback (most recent call last):
        ValueError: expected num_rows >= 1; got 0; use some thousand
    """
    if not holds:
        raise ValueError(f"expected {expected}; got {got}; {advice}")


def at_least(least: float, advice: str = "raise it") -> Validator:
    """Return a validator of a setting, or of each of several numbers in a tuple.

    None is taken where it is the default.

    Args:
        least: Smallest value.
        advice: Advice on what to do.
    """
    return _compared(operator.ge, f">= {least}", least, advice)


def at_most(most: float, advice: str) -> Validator:
    """Return a validator as :func:`at_least` does, for a largest value."""
    return _compared(operator.le, f"<= {most}", most, advice)


def positive(advice: str) -> Validator:
    """Return a validator as :func:`at_least` does, for values above zero."""
    return _compared(operator.gt, "> 0", 0, advice)


def _compared(
    holds: Callable[[Any, Any], bool], bounds: str, limit: float, advice: str
) -> Validator:
    def check(settings: Any, attribute: Any, value: Any) -> None:
        expected = f"{attribute.name} {bounds}"
        if attribute.default is None:
            expected += " or None"
            if value is None:
                return
        for number in value if isinstance(value, tuple) else (value,):
            is_right = isinstance(number, Real) and holds(float(number), limit)
            require(is_right, expected, repr(number), advice)

    return check


def of_class(kind: type) -> Validator:
    """Return a validator of a setting that is an instance of a class.

    Args:
        kind: The class.
    """
    advice = "True or False" if kind is bool else f"{kind.__name__}(...)"

    def check(settings: Any, attribute: Any, value: Any) -> None:
        if not isinstance(value, kind):
            raise TypeError(
                f"expected {attribute.name} of class {kind.__name__}; got {value!r}; "
                f"pass {advice}"
            )

    return check


def one_of(*known: Any) -> Validator:
    """Return a validator of a setting that has one of some values.

    Args:
        *known: The values.
    """
    valid = ", ".join(map(repr, known))

    def check(settings: Any, attribute: Any, value: Any) -> None:
        expected = f"{attribute.name} among {valid}"
        require(value in known, expected, repr(value), "choose one of these")

    return check


def did_you_mean(name: str, known: Iterable[str], otherwise: str) -> str:
    """Return the advice of an error about a name: the nearest ones that exist.

    Args:
        name: Name that was given.
        known: Names that exist.
        otherwise: Advice where none is near.

    Example:
        >>> did_you_mean("num_sample", ["num_samples", "seed"], "correct it")
        "did you mean 'num_samples'?"
    """
    near = difflib.get_close_matches(name, [*known], n=3, cutoff=0.5)
    return f"did you mean {' or '.join(map(repr, near))}?" if near else otherwise


def require_known(taking: str, given: Iterable[str], known: Sequence[str]) -> None:
    """Raise if a keyword is not known, with the one that was probably meant.

    Args:
        taking: Name of what takes the keywords.
        given: Keywords that were given.
        known: Keywords that it takes.

    Raises:
        TypeError: If there is another.
    """
    for name in given:
        if name not in known:
            advice = did_you_mean(name, known, "correct or remove it")
            raise TypeError(
                f"expected keywords of {taking} among {', '.join(known)}; got "
                f"{name!r}; {advice}"
            )


def suggests(taking: Taking) -> Taking:
    """Let a function or a class name the keyword that was probably meant.

    A subclass with its own ``__init__`` is not changed.
    """
    function: Any = taking.__init__ if isinstance(taking, type) else taking
    kinds = inspect.Parameter
    named = kinds.POSITIONAL_OR_KEYWORD, kinds.KEYWORD_ONLY
    name = taking.__qualname__.removesuffix(".__init__")
    entries = inspect.signature(function).parameters.values()
    known = [
        p.name for p in entries if p.kind in named and p.name not in ("self", "cls")
    ]

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        require_known(name, kwargs, known)
        return function(*args, **kwargs)

    if not isinstance(taking, type):
        return call  # pyright: ignore[reportReturnType]
    made: Any = taking
    made.__init__ = call
    return made


class Shown:
    """A class whose repr has the arguments that differ from their defaults.

    Only those are shown that an attribute of the same name keeps.
    """

    def __repr__(self) -> str:
        parts = []
        for entry in inspect.signature(type(self)).parameters.values():
            value = getattr(self, entry.name, None)
            is_plain = isinstance(value, bool | int | float | str)
            is_default = value is entry.default or (is_plain and value == entry.default)
            if value is None or is_default:
                continue
            is_first = entry.default is entry.empty and not parts
            prefix = "" if is_first else f"{entry.name}="
            parts.append(prefix + _short(value))
        return f"{type(self).__name__}({', '.join(parts)})"


def _short(value: Any, *, most: int = 6) -> str:
    """Return a value in a few words, of a list at most so many."""
    if isinstance(value, list | tuple):
        names = [str(getattr(entry, "name", entry)) for entry in value[:most]]
        left = [f"{len(value) - most} more"] if len(value) > most else []
        return f"[{', '.join([*names, *left])}]"
    if getattr(value, "ndim", 0) == 1 and len(value) > 1:
        return f"{len(value)} from {float(value[0]):g} to {float(value[-1]):g}"
    text = " ".join(repr(value).split())
    if text.startswith("<"):  # an address says nothing
        return getattr(value, "__name__", type(value).__name__)
    return text
