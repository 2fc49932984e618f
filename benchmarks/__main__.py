"""Run a benchmark by its name: ``python -m benchmarks NAME [--summary] [options]``.

A name is a module below ``benchmarks/``, with dots; that of a folder stands for its
``run``. Options are the arguments of the module's ``main``, with their types, defaults
and descriptions. ``Literal`` and ``Annotated[str, NAMES]`` are one of the names.
Without a name, all are listed. Benchmarks run on one thread, and warnings are not
shown.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import inspect
import re
import sys
import types
import typing
import warnings
from collections.abc import Callable
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

HERE = Path(__file__).parent
ARGUMENT = r"^ {4}(\w+): (.+(?:\n {8}.+)*)"  # its name and lines in a docstring


@lru_cache
def benchmarks() -> dict[str, str]:
    """Return the first line of each benchmark's docstring by its name.

    Files are parsed and not imported, since some need an extra.
    """
    found = {}
    for path in sorted(HERE.rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        if path.name != "__main__.py" and any(map(_is_main, tree.body)):
            *folders, last = path.relative_to(HERE).with_suffix("").parts
            parts = folders if last == "run" and folders else [*folders, last]
            found[".".join(parts)] = (ast.get_docstring(tree) or "").split("\n")[0]
    return found


def _is_main(node: ast.stmt) -> bool:
    """Return whether a statement defines ``main``, or makes one of its parts."""
    targets = getattr(node, "targets", ())
    return "main" in (
        getattr(node, "name", ""),
        *(getattr(t, "id", "") for t in targets),
    )


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
    """Return a parser of the arguments of a benchmark's main.

    An argument with a default, or by keyword alone, is an option; another is given by
    its place.

    Args:
        main: The function. Its arguments are flags, numbers, texts, paths, sequences
            of these, or None.
        name: Name of the benchmark.
    """
    lines = re.findall(ARGUMENT, inspect.getdoc(main) or "", re.M)
    described = {key: " ".join(text.split()) for key, text in lines}
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks {name}",
        description=(inspect.getdoc(main) or "").split("\n")[0],
    )
    hints = typing.get_type_hints(main, include_extras=True)
    for argument, given in inspect.signature(main).parameters.items():
        kind, choices = hints[argument], None
        if typing.get_origin(kind) is typing.Annotated:
            kind, choices = typing.get_args(kind)
        if typing.get_origin(kind) in (types.UnionType, typing.Union):  # or None
            kind = next(k for k in typing.get_args(kind) if k is not type(None))
        if typing.get_origin(kind) is Literal:
            choices = typing.get_args(kind)
            kind = type(choices[0])
        options: dict[str, Any] = {"help": described.get(argument)}
        parts = typing.get_args(kind)
        if kind is bool:
            options["action"] = "store_true"
        elif parts:  # a sequence, or a tuple of so many
            num = len(parts) if typing.get_origin(kind) is tuple else "+"
            options |= {"nargs": num, "type": parts[0]}
        else:
            options["type"] = kind
        if choices:
            options["choices"] = [*choices]
        flag = "--" + argument.replace("_", "-")
        is_required = given.default is given.empty
        if is_required and given.kind is not given.KEYWORD_ONLY:
            flag = argument
        elif is_required:
            options["required"] = True
        else:
            options["default"] = given.default
        parser.add_argument(flag, **options)
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
    given = vars(parser_of(run, name).parse_args(options))
    from sbi_active.threads import single_thread

    with single_thread(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return run(**given) or 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
