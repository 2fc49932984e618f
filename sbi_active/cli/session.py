"""Commands on one campaign, which is opened when one needs it, and kept.

``sbi-active serve DIR`` takes them from a program: a JSON request and a JSON answer a
line.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, Literal

import click

from sbi_active.campaign.telling import flat
from sbi_active.cli import declare as cli
from sbi_active.cli.output import Answer, as_line, failure, output_to_errors
from sbi_active.cli.record import Record, Unsure, digest, sum_up_campaign

#: What a command works on: trials without torch where these suffice; the campaign as it
#: is read; one that simulates; one that is mended.
Need = Literal["record", "reader", "simulator", "repair"]
#: Commands on a campaign by name, which a request may call too.
ON_CAMPAIGN: set[str] = set()


def on_campaign(
    *params: click.Parameter, need: Need
) -> Callable[[Callable[..., Answer]], Callable[..., Answer]]:
    """Make a function of a campaign and options a command on a folder.

    Args:
        *params: Arguments and options of the command.
        need: Kind of campaign that it works on.
    """

    def decorate(function: Callable[..., Answer]) -> Callable[..., Answer]:
        more: Any = {"ignore_unknown_options": need == "record"}  # as numbers are: -1

        @cli.command(cli.DIR, *params, cli.JSON, cli.TRUST, **more)
        @wraps(function)
        def call(folder: Path, **options: Any) -> Answer:
            with click.get_current_context().obj or Session(folder) as session:
                return session.call(function, need, **options)

        ON_CAMPAIGN.add(function.__name__)
        return call

    return decorate


class Session:
    """Calls commands on one campaign, which is loaded again only where it has to be.

    Args:
        folder: Folder of the campaign.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._campaign: Any = None
        self._opened: tuple[object, ...] = ()
        self._is_used = False

    def __enter__(self) -> Session:
        self._is_used = False
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if self._campaign is not None and self._is_used:
            self._campaign.close()  # let others write
            self._opened = (*self._opened[:-1], digest(self.folder))
        if kind is not None:  # what went wrong may be that another process wrote
            self._campaign = None

    def call(
        self,
        function: Callable[..., Answer],
        need: Need,
        *,
        trust: bool = False,
        simulator: str | None = None,
        simulator_changed: bool = False,
        **options: Any,
    ) -> Answer:
        """Return the answer of a command.

        Args:
            function: Function of the command.
            need: Kind of campaign that it works on.
            trust: Whether to import what the folder names.
            simulator: Place of the simulator; None if the folder says it.
            simulator_changed: Whether to take another simulator than before.
            **options: Options of the command.
        """
        wants = (trust, simulator, digest(self.folder))
        is_same = self._campaign is not None and wants == self._opened
        if need == "record" and not trust and not is_same:
            with contextlib.suppress(Unsure):
                return function(Record(self.folder), **options)
        # A report or an export shows more with a simulator.
        simulates = need == "simulator" or need == "reader" and (trust or simulator)
        if simulates and self._campaign is not None:
            is_same = is_same and self._campaign.simulator is not None
        if not is_same or simulator_changed or need == "repair":
            from sbi_active.cli.problem import open_campaign

            self._opened, self._campaign = wants, None
            self._campaign = open_campaign(
                self.folder,
                simulates=bool(simulates),
                simulator=simulator,
                trust=trust,
                simulator_changed=simulator_changed,
                repair=need == "repair",
            )
        self._is_used = True
        answer = function(self._campaign, **options)
        if need == "simulator":
            sum_up_campaign(self._campaign)
        return answer


@cli.command(cli.DIR, cli.SIMULATOR, cli.TRUST)
def serve(folder: Path, **given: Any) -> None:
    """Answer requests of a program, a JSON object a line, as {"command": "ask"}.

    They end with standard input. What simulators print goes to standard error.
    """
    session = Session(folder)
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    with answers, output_to_errors():
        for line in filter(bytes.strip, sys.stdin.buffer):
            print(as_line(_answer(line, session, given)), file=answers, flush=True)


def _answer(line: bytes, session: Session, given: dict[str, Any]) -> dict[str, Any]:
    """Return the answer to a request, or its error; both with the id that it has."""
    name: dict[str, Any] = {}
    try:
        request = _request(line)
        name = {"id": request.pop("id")} if "id" in request else {}
        return {**name, "answer": _called(request, session, given)}
    except Exception as error:
        return {**name, "error": failure(error)}


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
    name = request.pop("command", None)
    if not isinstance(name, str) or name not in ON_CAMPAIGN:
        raise ValueError(
            f"expected a command among {', '.join(sorted(ON_CAMPAIGN))}; got "
            f'{name!r:.80}; write one of these, as in {{"command": "ask"}}'
        )
    called = cli.program.commands[name]
    written = cli.named(called, request, "the request")
    if "x" in written:  # numbers of any shape, null for one not measured
        written["x"] = ["nan" if v is None else v for v in flat(written["x"])]
    held = {"default_map": {**given, **written, "folder": session.folder}}
    root = click.get_current_context().find_root()
    with called.make_context(name, [], parent=root, obj=session, **held) as context:
        return called.invoke(context).data
