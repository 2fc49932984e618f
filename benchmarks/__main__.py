"""Run a benchmark by its name: ``python -m benchmarks NAME [--summary] [options]``.

A name is a module below ``benchmarks/``, with dots; that of a folder stands for its
``run``. Options are the keyword arguments of the module's ``main``, with their types
and defaults. Without a name, all are listed.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import inspect
import sys
import types
import typing
from collections.abc import Callable
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent


@lru_cache
def benchmarks() -> dict[str, str]:
    """Return the first line of each benchmark's docstring by its name.

    Files are parsed and not imported, since some need an extra.
    """
    found = {}
    for path in sorted(HERE.rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        mains = [node for node in tree.body if getattr(node, "name", "") == "main"]
        if mains and path.name != "__main__.py":
            *folders, last = path.relative_to(HERE).with_suffix("").parts
            parts = folders if last == "run" and folders else [*folders, last]
            found[".".join(parts)] = (ast.get_docstring(tree) or "").split("\n")[0]
    return found


def module_of(name: str) -> str:
    """Return the module of a benchmark's name.

    Raises:
        ValueError: If there is none of this name.
    """
    known = benchmarks()
    name = name.removeprefix("benchmarks.").removesuffix(".run")
    if name not in known:
        near = difflib.get_close_matches(name, known, n=3) or [*known]
        raise ValueError(
            f"expected the name of a benchmark; got {name!r}; pass one such as "
            f"{', '.join(near)}"
        )
    path = HERE.joinpath(*name.split("."))
    return f"benchmarks.{name}" + (".run" if path.is_dir() else "")


def parser_of(main: Callable[..., Any], name: str) -> argparse.ArgumentParser:
    """Return a parser of the keyword arguments of a function.

    Args:
        main: The function. Its arguments are flags, numbers, texts, paths, lists of
            these, or None; its docstring says what they are for.
        name: Name of the benchmark.
    """
    text = inspect.getdoc(main) or ""
    described = dict(
        line.strip().split(": ", 1) for line in text.split("\n") if ": " in line
    )
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks {name}", description=text.split("\n")[0]
    )
    hints = typing.get_type_hints(main)
    for argument, given in inspect.signature(main).parameters.items():
        kind = hints[argument]
        if isinstance(kind, types.UnionType):  # or None
            kind = next(k for k in typing.get_args(kind) if k is not type(None))
        options: dict[str, Any] = {"default": given.default}
        options["help"] = described.get(argument)
        if kind is bool:
            options["action"] = "store_true"
        elif typing.get_origin(kind) is list:
            options |= {"nargs": "+", "type": typing.get_args(kind)[0]}
        else:
            options["type"] = kind
        parser.add_argument("--" + argument.replace("_", "-"), **options)
    return parser


def main(argv: list[str]) -> int:
    """Run a benchmark, and return the exit status.

    Args:
        argv: Its name, and its options.
    """
    if not argv or argv[0] in ("-h", "--help", "--list"):
        print((__doc__ or "").strip() + "\n")
        for name, line in benchmarks().items():
            print(f"{name:32}{line}")
        return 0
    name, *options = argv
    try:
        module = module_of(name)
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    run = import_module(module).main
    if inspect.signature(run).parameters:
        run(**vars(parser_of(run, name).parse_args(options)))
        return 0
    before = sys.argv
    sys.argv = [name, *options]  # it reads the command line by itself
    try:
        run()
    finally:
        sys.argv = before
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
