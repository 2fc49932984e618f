"""Names of the last version: they still work, and a warning says the new one."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Mapping
from typing import Any

from sbi_active.messages import warn


def former_names(
    package: str, names: Mapping[str, str], *, stacklevel: int = 2
) -> Callable[[str], Any]:
    """Return a ``__getattr__`` of a package that finds its former names.

    Args:
        package: Name of the package.
        names: Former name: where it is now, as ``"package:Name"``.
        stacklevel: Of the warning; 2 where the function is ``__getattr__`` itself.

    Returns:
        A function of a name. It raises AttributeError for names that never were.
    """

    def find(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        home, _, new = names[name].partition(":")
        warn(
            f"{package}.{name} goes in the next version: use {home}.{new}",
            DeprecationWarning,
            stacklevel=stacklevel,
        )
        return pkgutil.resolve_name(names[name])

    return find
