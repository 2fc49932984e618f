"""Objects that a command line names, as ``MODULE:NAME``."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any


def load_object(name: str) -> Any:
    """Import what a user names.

    Args:
        name: ``module:attribute``; modules of the current folder come first. Or
            ``folder/file.py:attribute``.

    Raises:
        ValueError: If there is no such module or attribute.
    """
    module, _, attribute = name.partition(":")
    if not module or not attribute:
        raise ValueError(
            f"expected MODULE:NAME; got {name!r}; write, say, my_robot:simulator"
        )
    file = None
    if module.endswith(".py"):
        file = Path(module).resolve()
        if not file.is_file():
            raise ValueError(f"expected a file; got none at {file}; check the path")
        sys.path.insert(0, str(file.parent))
        module = file.stem
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        loaded = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] != module.split(".")[0]:
            raise  # an import within the module
        raise ValueError(
            f"expected a module {module!r}; got none in {here} or among the installed "
            "ones; run where it lies, or install it"
        ) from error
    origin = getattr(loaded, "__file__", None)
    if file is not None and (origin is None or Path(origin).resolve() != file):
        raise ValueError(
            f"expected a file whose name no other module has; got {file.name}, which "
            f"is also {origin or 'built in'}; rename the file"
        )
    try:
        return getattr(loaded, attribute)
    except AttributeError as error:
        raise ValueError(
            f"expected {attribute!r} in module {module!r}; got none; choose among "
            f"{', '.join(n for n in vars(loaded) if not n.startswith('_'))}"
        ) from error
