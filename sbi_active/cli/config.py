"""Options that stand in a file of TOML, or in a request, in place of words."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from sbi_active.cli.declare import FILE, FORMER, option

#: Options that no file and no request sets: where these are, and who is trusted.
UNWRITTEN = ("config", "trust", "json")
PROBLEM = "problem.toml"  # options of a folder of recordings


def take_config(
    ctx: click.Context, _: click.Parameter, path: Path | None
) -> Path | None:
    """Take from a TOML file what the command line leaves out."""
    if path is None or ctx.resilient_parsing:
        return path
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib

    try:
        values = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except ValueError as error:
        raise ValueError(
            f"expected TOML in {path}; got {error}; write options as in "
            'theta-low = "0,1"'
        ) from error
    found = named(ctx.command, values, str(path))
    ctx.default_map = {k: _beside(path.parent, v) for k, v in found.items()}
    return path


CONFIG = option(
    "--config",
    "with options by their names; in a folder of recordings problem.toml",
    FILE,
    "FILE.toml",
    is_eager=True,
    expose_value=False,
    callback=take_config,
)


def take_problem(ctx: click.Context, param: click.Parameter, folder: Path) -> Path:
    """Take from a folder's problem.toml what no other file and no option gives."""
    path = folder / PROBLEM
    if ctx.default_map is None and path.is_file():
        take_config(ctx, param, path)
    return folder


PROBLEM_FILE: Any = {"is_eager": True, "callback": take_problem}


def named(
    command: click.Command, values: Mapping[str, Any], place: str
) -> dict[str, Any]:
    """Return values of TOML or JSON by the names of a command's parameters.

    Args:
        command: The command.
        values: Values by names, with dashes or without.
        place: Place where they stand, for the error.

    Raises:
        ValueError: If a name is none of a parameter.
    """
    known = [p.name for p in command.params if p.name and p.name not in UNWRITTEN]
    found = {name.replace("-", "_"): value for name, value in values.items()}
    former = {name.replace("-", "_"): now for name, now in FORMER.items()}
    if "set" in known and (old := [name for name in found if name in former]):
        settings = [f"{former[name]}={found.pop(name)}" for name in old]
        found["set"] = [*found.get("set", []), *settings]
    for name in {*found} - {*known}:
        raise ValueError(
            f"expected options among {', '.join(sorted(known)) or 'none'}; got "
            f"{name!r} in {place}; remove it or write one of these"
        )
    return {name: value for name, value in found.items() if value is not None}


def pairs_of(texts: Sequence[str]) -> dict[str, str]:
    """Return the parts of texts NAME=VALUE.

    Raises:
        ValueError: If one is no such text.
    """
    pairs = {}
    for text in texts:
        name, _, value = text.partition("=")
        if not (name and value):
            raise ValueError(f"expected NAME=VALUE; got {text!r}; write, say, target=2")
        pairs[name] = value
    return pairs


def as_json(text: str) -> Any:
    """Return what a text is as JSON, or the text itself."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


def _beside(folder: Path, value: Any) -> Any:
    """Return what a file says, with the path of programs that lie beside it."""
    if isinstance(value, list):
        return [_beside(folder, part) for part in value]
    file, colon, name = value.partition(":") if isinstance(value, str) else ("", "", "")
    is_there = file.endswith(".py") and (folder / file).is_file()
    return f"{folder / file}{colon}{name}" if is_there else value
