"""Values as JSON holds them, and numbers as people read them."""

from __future__ import annotations

import math
from typing import Any


def plain(value: Any) -> Any:
    """Return numbers, texts, lists and dicts in place of arrays, tuples and sets.

    Args:
        value: Any of these; a number that is not finite becomes None, and a set is
            sorted.

    Example:
        >>> plain({"gain": (1.5, float("nan")), "names": frozenset({"b", "a"})})
        {'gain': [1.5, None], 'names': ['a', 'b']}
    """
    if isinstance(value, dict):
        return {str(key): plain(part) for key, part in value.items()}
    if isinstance(value, frozenset):
        return sorted(value)
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    if hasattr(value, "tolist"):  # an array or a tensor
        return plain(value.tolist())
    is_lost = isinstance(value, float) and not math.isfinite(value)
    return None if is_lost else value


def with_error(mean: float, sd: float) -> str:
    """Return a mean to the second digit of its deviation; nothing for NaN.

    A mean that is known better than that has six digits.

    Args:
        mean: Mean of the draws.
        sd: Standard deviation of the draws.

    Example:
        >>> with_error(0.35992, 0.00071), with_error(1234.5, 56.7)
        ('0.35992 +- 0.00071', '1234 +- 57')
        >>> with_error(159.873313255, 2.8e-14), with_error(-0.003, 1.9)
        ('159.873 +- 2.8e-14', '0.0 +- 1.9')
    """
    if math.isnan(mean):
        return ""
    size = abs(mean) + sd
    if not (sd > 0 and 1e-4 <= size < 1e6):  # powers of ten, or no deviation
        return f"{mean:.4g} +- {sd:.2g}"
    places = max(1 - int(f"{sd:.1e}".split("e")[1]), 0)  # after rounding
    most = max(5 - int(f"{mean:.5e}".split("e")[1]), 0)
    error = f"{sd:.{places}f}" if places <= most else f"{sd:.2g}"
    digits = min(places, most)
    return f"{round(mean, digits) + 0.0:.{digits}f} +- {error}"  # no "-0.0"
