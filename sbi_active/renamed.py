"""Names of packages: imported when they are used, and those of the last version.

The latter still work, and a warning says the new one.
"""

from __future__ import annotations

import pkgutil
import sys
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
            "SA701",
            f"{package}.{name} goes in the next version: use {home}.{new}",
            stacklevel=stacklevel,
        )
        return pkgutil.resolve_name(names[name])

    return find


def lazy_names(
    package: str, homes: Mapping[str, str], former: Callable[[str], Any]
) -> Callable[[str], Any]:
    """Return a ``__getattr__`` of a package that imports a name when it is used.

    A package then costs nothing where only a module of it is wanted that needs little.

    Args:
        package: Name of the package.
        homes: Modules below it, and the names that each defines, apart by spaces.
        former: Finds all other names, see :func:`former_names`.
    """
    home = {name: where for where, names in homes.items() for name in names.split()}

    def find(name: str) -> Any:
        if name not in home:
            return former(name)
        value = pkgutil.resolve_name(f"{package}.{home[name]}:{name}")
        setattr(sys.modules[package], name, value)
        return value

    return find
