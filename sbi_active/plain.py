"""Values as JSON holds them."""

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
