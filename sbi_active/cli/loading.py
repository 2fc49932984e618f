"""What a command line names: objects as ``MODULE:NAME``, tasks with their options."""

from __future__ import annotations

import importlib
import inspect
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sbi_active.cli.declared import in_campaign
from sbi_active.cli.words import place_of
from sbi_active.tasks import TASKS, Task, get_task  # pyright: ignore


def load_object(name: str, folder: str | None = None) -> Any:
    """Import what a user names.

    Args:
        name: ``module:attribute``, or ``path/file.py:attribute``.
        folder: Where paths begin and modules are looked for first; None is the current
            one, in which no modules are looked for where it is a campaign's.

    Raises:
        ValueError: If there is no such module or attribute, or it cannot be imported.
    """
    module, _, attribute = name.partition(":")
    if not module or not attribute:
        raise ValueError(
            f"expected MODULE:NAME; got {name!r}; write, say, my_robot:simulator"
        )
    file, here = None, Path.cwd() if folder is None else Path(folder)
    if module.endswith(".py"):
        file = Path(here, module).resolve()
        if not file.is_file():
            raise ValueError(f"expected a file; got none at {file}; check the path")
        sys.path.insert(0, str(file.parent))
        module = file.stem
    if str(here) not in sys.path and (folder is not None or not in_campaign(here)):
        sys.path.insert(0 if file is None else len(sys.path), str(here))
    try:
        loaded = importlib.import_module(module)
    except (Exception, SystemExit) as error:
        lacks = (error.name or "") if isinstance(error, ModuleNotFoundError) else ""
        if lacks and lacks.partition(".")[0] == module.partition(".")[0]:
            raise ValueError(
                f"expected a module {module!r}; got none in {here} or among the "
                "installed ones; run where it lies, or install it"
            ) from error
        raise ValueError(
            f"expected {name} to be imported; got {type(error).__name__}: {error}"
            f"{place_of(error)}; correct it"
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


def make_task(name: str, options: Sequence[str]) -> Task:
    """Return a task with the options of a command line.

    Args:
        name: One of ``TASKS``.
        options: Each ``NAME=VALUE``.

    Raises:
        ValueError: If an option has no value, the task has none of that name, or what
            the task needs is not installed or its data are elsewhere.

    Example:
        >>> make_task("numerical", ["variant=sinh"]).variant
        'sinh'
    """
    values = dict(_parse(option) for option in options)
    if name in TASKS:
        known = [*inspect.signature(TASKS[name]).parameters]
        unknown = [option for option in values if option not in known]
        if unknown:
            raise ValueError(
                f"expected options of {name!r} among {', '.join(known) or 'none'}; got "
                f"{unknown[0]!r}; drop it or choose one of these"
            )
    try:
        return get_task(name, **values)
    except ImportError as error:  # its text has the line that installs it
        raise ValueError(str(error)) from error
    except FileNotFoundError as error:
        raise ValueError(f"{error}, as --option data=FOLDER") from error
    except TypeError as error:
        raise ValueError(
            f"expected values that {name!r} can use; got {values} ({error}); "
            "correct the types"
        ) from error


def _parse(option: str) -> tuple[str, Any]:
    name, separator, text = option.partition("=")
    if not separator or not name:
        raise ValueError(
            f"expected --option NAME=VALUE; got {option!r}; write, say, target=2"
        )
    try:
        return name, json.loads(text)
    except json.JSONDecodeError:
        return name, text
