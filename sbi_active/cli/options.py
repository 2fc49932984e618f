"""Options of a task, as ``--option NAME=VALUE``."""

from __future__ import annotations

import inspect
import json
from collections.abc import Sequence
from typing import Any

from sbi_active.tasks import TASKS, Task, get_task  # pyright: ignore


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
