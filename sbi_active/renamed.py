"""Names of packages: imported when they are used, and those of the last version.

Former names, listed in ``renamed.txt`` beside this file, and former keywords still
work, and a warning gives the new ones.
"""

from __future__ import annotations

import ast
import functools
import inspect
import pkgutil
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from sbi_active.expected import suggests
from sbi_active.messages import warn

Taking = TypeVar("Taking", bound=Callable[..., Any])


@functools.cache
def former() -> dict[str, str]:
    """Return where names of the last version are now, as ``"package:Name"``."""
    text = Path(__file__).with_suffix(".txt").read_text(encoding="utf-8")
    return dict(line.split(" = ") for line in text.splitlines())


def former_names(package: str) -> Callable[[str], Any]:
    """Return a ``__getattr__`` of a package that finds its former names.

    It raises AttributeError for names that never were.
    """

    def find(name: str) -> Any:
        now = former().get(f"{package}.{name}")
        if now is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        new = now.replace(":", ".")
        warn(f"SA701 {package}.{name} goes in the next version: use {new}")
        return pkgutil.resolve_name(now)

    return find


def lazy_names(package: str) -> Callable[[str], Any]:
    """Return a ``__getattr__`` of a package that imports a name when it is used.

    A package then costs nothing where only a module of it is wanted that needs little.
    The names, and where they come from, are the imports that the package's file has
    under ``if TYPE_CHECKING``, which type checkers read as well. Former names are found
    as by :func:`former_names`.
    """
    loader: Any = getattr(sys.modules[package].__spec__, "loader", None)
    tree = ast.parse(loader.get_source(package))  # of a zipped package as well
    blocks = [node for node in tree.body if isinstance(node, ast.If)]
    home = {
        alias.name: line.module
        for block in blocks
        for line in block.body
        if isinstance(line, ast.ImportFrom)
        for alias in line.names
    }
    find_former = former_names(package)

    def find(name: str) -> Any:
        if name not in home:
            return find_former(name)
        value = pkgutil.resolve_name(f"{home[name]}:{name}")
        setattr(sys.modules[package], name, value)
        return value

    return find


def grouped(values: Mapping[str, Any], groups: Mapping[str, Any]) -> dict[str, Any]:
    """Return values by name, with loose ones in the settings that they belong to.

    Args:
        values: Values, some of which are fields of the settings.
        groups: The class of each settings by the name of its value.

    Example:
        >>> from sbi_active.simulation import Workers
        >>> grouped({"seed": 0, "num_workers": 2}, {"workers": Workers})
        {'seed': 0, 'workers': Workers(num_workers=2, time_limit=None, num_retries=0)}
    """
    found = dict(values)
    for group, kind in groups.items():
        names = [name for name in inspect.signature(kind).parameters if name in found]
        loose = {name: found.pop(name) for name in names}
        if loose:
            whole = found.get(group) or kind()
            whole = whole if isinstance(whole, kind) else kind(whole)
            found[group] = kind(**{**vars(whole), **loose})
    return found


def takes_loose(**groups: Any) -> Callable[[Taking], Taking]:
    """Let a function or a class take fields of its settings as keywords.

    They work for one version, with a warning. A class has them as attributes as well.

    Args:
        **groups: Groups of options, as in :func:`grouped`.
    """
    home = {name: g for g in groups for name in inspect.signature(groups[g]).parameters}

    def warned(what: str, name: str) -> None:
        place = f"{home[name]}={groups[home[name]].__name__}({name}=)"
        warn(f"SA701 {what}({name}=) goes in the next version: use {place}")

    def decorate(taking: Any) -> Any:
        function = suggests(taking.__init__ if isinstance(taking, type) else taking)

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            loose = home.keys() & kwargs.keys()
            for name in sorted(loose):
                warned(taking.__name__, name)
            return function(*args, **grouped(kwargs, groups) if loose else kwargs)

        def find(self: Any, name: str) -> Any:
            group = vars(self).get(home.get(name, ""))
            if group is None:
                raise AttributeError(f"{taking.__name__!r} has no attribute {name!r}")
            warned(taking.__name__, name)
            return getattr(group, name)

        if not isinstance(taking, type):
            return call
        taking.__init__, taking.__getattr__ = call, find
        return taking

    return decorate
