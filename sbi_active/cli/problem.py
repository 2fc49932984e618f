"""What a folder of recordings says of its simulator, beside the command line."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from sbi_active.cli.folder import read_config
from sbi_active.cli.loading import load_object

#: Options by their names without the dashes in front; objects under their names.
CONFIG, MODULE = "problem.toml", "problem.py"
NAMED = ("simulator", "prior", "actions", "effects")


def read_problem(arguments: argparse.Namespace) -> None:
    """Take from a folder's problem file what the command line leaves out.

    ``problem.toml`` has options of the command, in which files are those of the folder;
    ``problem.py`` has the objects that they name, under the options' own names.

    Args:
        arguments: Changed in place.

    Raises:
        ValueError: If the file has no such options.
    """
    folder: Path = arguments.trials
    config = arguments.config
    if config is None and (folder / CONFIG).is_file():
        config = folder / CONFIG
    if config is not None:
        arguments.config = config
        given = {name: getattr(arguments, name) for name in NAMED}
        read_config(arguments)
        for name in NAMED:
            if given[name] is None:
                setattr(arguments, name, _within(config.parent, arguments, name))
    if not (folder / MODULE).is_file() or arguments.task is not None:
        return
    path = folder / MODULE
    load_object(f"{path}:__name__")
    module = sys.modules[path.stem]
    has_bounds = arguments.theta_low is not None or arguments.theta_high is not None
    for name in NAMED:
        if name == "prior" and has_bounds:
            continue
        if getattr(arguments, name) is None and hasattr(module, name):
            value = f"{path}:{name}"
            setattr(arguments, name, [value] if name == "actions" else value)


def _within(
    folder: Path, arguments: argparse.Namespace, name: str
) -> str | list[str] | None:
    """Return what a file names, with the path of files that lie beside it."""

    def found(text: str) -> str:
        file, colon, what = text.partition(":")
        beside = file.endswith(".py") and (folder / file).is_file()
        return f"{folder / file}{colon}{what}" if beside else text

    value = getattr(arguments, name)
    if isinstance(value, list):
        return [found(part) for part in value]
    return None if value is None else found(value)
