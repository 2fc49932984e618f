"""Commands on one campaign, which is opened when one needs it, and kept.

``sbi-active serve DIR`` takes them from a program: a JSON request and a JSON answer a
line.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import click

from sbi_active.cli import trials
from sbi_active.cli.options import as_written
from sbi_active.cli.output import Answer, as_line, failure, output_to_errors
from sbi_active.cli.record import Record, Unsure, digest

#: Commands for which the simulator runs.
SIMULATE = ("ask", "update", "criticize", "adopt")
SUMMED = ("ask", "update", "adopt")  # of these, that hold the right to write
LIGHT = ("tell", "correct", "withdraw", "status")


class Session:
    """Calls commands on one campaign, which is loaded again only where it has to be.

    Args:
        folder: Folder of the campaign.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._campaign: Any = None
        self._opened: dict[str, Any] = {}

    def __enter__(self) -> Session:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if self._campaign is not None:
            self._campaign.close()  # let others write
            self._opened["files"] = digest(self.folder)
        if kind is not None:  # what went wrong may be that another process wrote
            self._campaign = None

    def call(
        self,
        name: str,
        *,
        trust: bool = False,
        simulator: str | None = None,
        simulator_changed: bool = False,
        **options: Any,
    ) -> Answer | None:
        """Return the answer of a command.

        Args:
            name: Name of the command.
            trust: Whether to import what the folder names.
            simulator: Place of the simulator; None if the folder says it.
            simulator_changed: Whether to take another simulator than before.
            **options: Options of the command.
        """
        wants = {"trust": trust, "simulator": simulator, "files": digest(self.folder)}
        exports = name == "export" and (trust or simulator is not None)
        simulates = name in SIMULATE or exports
        held = self._campaign
        is_same = held is not None and wants == self._opened
        has_all = held is not None and (not simulates or held.simulator is not None)
        if name in LIGHT and not trust and not is_same:
            with contextlib.suppress(Unsure):
                return getattr(trials, name)(Record(self.folder), **options)
        if not (is_same and has_all) or simulator_changed or name == "repair":
            self._opened, self._campaign = wants, None
            self._campaign = import_module("sbi_active.cli.campaign").open_campaign(
                self.folder,
                simulates=simulates,
                simulator=simulator,
                trust=trust,
                simulator_changed=simulator_changed,
                repair=name == "repair",
            )
        # What a repair gave up is said by warnings; what is left is the answer.
        home, function = trials, "status" if name == "repair" else name
        if not hasattr(trials, function):
            home = import_module("sbi_active.cli.campaign")
        answer = getattr(home, function)(self._campaign, **options)
        if name in SUMMED:
            trials.sum_up_campaign(self._campaign)
        return answer


def serve(folder: Path, *, simulator: str | None, trust: bool) -> None:
    """Answer requests until standard input ends.

    A request names a command and its options. What simulators print goes to standard
    error, in C and in workers too.
    """
    given = {"simulator": simulator, "trust": trust}
    session = Session(folder)
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    with answers, output_to_errors():
        for line in filter(bytes.strip, sys.stdin.buffer):
            print(as_line(_answer(line, session, given)), file=answers, flush=True)


def _answer(line: bytes, session: Session, given: dict[str, Any]) -> dict[str, Any]:
    """Return the answer to a request, or its error; both with the id that it has."""
    named: dict[str, Any] = {}
    try:
        request = _request(line)
        named = {"id": request.pop("id")} if "id" in request else {}
        return {**named, "answer": _called(request, session, given)}
    except Exception as error:
        return {**named, "error": failure(error)}


def _request(line: bytes) -> dict[str, Any]:
    with contextlib.suppress(ValueError, RecursionError):
        request = json.loads(line)
        if isinstance(request, dict):
            return request
    raise ValueError(
        f'expected a request as {{"command": "ask"}}; got {line.strip()!a:.80}; write '
        "one JSON object a line"
    )


def _called(
    request: dict[str, Any], session: Session, given: dict[str, Any]
) -> dict[str, Any]:
    root = click.get_current_context().find_root()
    assert isinstance(root.command, click.Group)
    known = {
        name: {str(param.name): param for param in command.params}
        for name, command in root.command.commands.items()
        if {"folder", "json"} <= {param.name for param in command.params}
    }
    name = request.pop("command", None)
    if not isinstance(name, str) or name not in known:
        raise ValueError(
            f"expected a command among {', '.join(known)}; got {name!r:.80}; "
            'write one of these, as in {"command": "ask"}'
        )
    options = known[name]
    written = {key: value for key, value in given.items() if key in options}
    written["folder"] = session.folder
    del options["folder"]
    written |= as_written([*options.values()], request, "the request")
    command, held = root.command.commands[name], {"default_map": written}
    with command.make_context(name, [], parent=root, obj=session, **held) as context:
        return command.invoke(context).data
