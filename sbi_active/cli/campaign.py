"""Commands on a campaign, which is opened when one needs it, and kept.

``sbi-active serve DIR`` takes them from a program: a JSON request and a JSON answer a
line.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any, Literal

import click

from sbi_active.campaign.telling import flat, shaped
from sbi_active.cli import declare as cli
from sbi_active.cli.output import Answer, as_line, failure, output_to_errors, say
from sbi_active.cli.record import (
    Record,
    Unsure,
    answer_of,
    digest,
    numbers_of,
    place_of,
    sum_up_campaign,
    trial_of,
)
from sbi_active.cli.trusted import read_declared, write_declared

#: What a command works on: trials without torch where these suffice; the campaign as it
#: is read; one that simulates.
Need = Literal["record", "reader", "simulator"]
#: Commands on a campaign by name, which a request may call too.
ON_CAMPAIGN: dict[str, click.Command] = {}


def on_campaign(
    *params: click.Parameter, need: Need
) -> Callable[[Callable[..., Answer]], click.Command]:
    """Make a function of a campaign and options a command on a folder.

    Args:
        *params: Arguments and options of the command.
        need: Kind of campaign that it works on.
    """

    def decorate(function: Callable[..., Answer]) -> click.Command:
        @wraps(function)
        def call(folder: Path, **options: Any) -> Answer:
            session = click.get_current_context().obj or Session(folder)
            return session.call(function, need, **options)

        # Numbers may begin with a minus.
        settings: Any = {"ignore_unknown_options": need == "record"}
        made = cli.command(cli.DIR, *params, cli.JSON, cli.TRUST, **settings)(call)
        return ON_CAMPAIGN.setdefault(function.__name__, made)

    return decorate


class Session:
    """Calls commands on one campaign, which is loaded again only where it has to be.

    Args:
        folder: Folder of the campaign.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._campaign: Any = None
        self._opened: tuple[str | None, str] = (None, "")

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
        is_known = self._opened == (simulator, digest(self.folder))
        campaign: Any = self._campaign if is_known else None
        self._campaign = None
        if need == "record" and campaign is None:
            with contextlib.suppress(Unsure):
                return function(Record(self.folder), **options)
        # A report or an export shows more with a simulator.
        simulates = need == "simulator" or need == "reader" and (trust or simulator)
        lacks = simulates and getattr(campaign, "simulator", None) is None
        if campaign is None and not simulates:
            from sbi_active import Campaign
            from sbi_active.campaign.storage.codec import NotStorableError

            try:
                campaign = Campaign.load(self.folder)
            except NotStorableError:  # a prior that only a program can make
                lacks = True
        if lacks or simulator_changed:
            from sbi_active.cli.problem import open_campaign

            how = {"trust": trust, "simulator_changed": simulator_changed}
            campaign = open_campaign(self.folder, simulator=simulator, **how)
        assert campaign is not None
        with campaign:  # then others may write
            answer = function(campaign, **options)
            if need == "simulator":
                sum_up_campaign(campaign)
        # Not after an error, which may be that another process wrote.
        self._campaign, self._opened = campaign, (simulator, digest(self.folder))
        return answer


MANY = 5  # numbers, more than somebody types
TRIAL = cli.argument("trial", "TRIAL", int)
REASON = cli.option("--reason", "kept with the trial", default="")
OUTCOME = [
    cli.argument("x", "[X]...", cli.TEXT, nargs=-1, required=False),
    cli.option("--file", "with the numbers", cli.FILE, "X.csv"),
    cli.option("--invalid", "it ran and gave no measurement", None),
    cli.option("--missing", "a fault that tells nothing hit it", None),
    cli.option("--action", "executed, if another one", cli.NUMBERS, "A,B,..."),
]


@cli.command(
    *(cli.DIR, cli.CONFIG, *cli.PROBLEM, cli.EFFECTS),
    cli.option("--names", "of the action's entries", metavar="A,B,..."),
    cli.option("--units", "of the action's entries", metavar="A,B,..."),
    *(cli.METHOD, cli.SEED, *cli.OF_CAMPAIGN),
)
def init(folder: Path, method: str, seed: int, **given: Any) -> None:
    """Make a campaign in a new folder, also by --config."""
    from sbi_active import Campaign
    from sbi_active.cli.problem import campaign_options, problem_of

    options = campaign_options(given)
    *problem, effects = problem_of(given)
    how: Any = {"method": method, "seed": seed, "options": options, "effects": effects}
    with Campaign(*problem, directory=folder, **how) as campaign:
        write_declared(folder, **given)
        sum_up_campaign(campaign)
    print(f"{folder}: a campaign of {campaign.actions}\nnext: sbi-active ask {folder}")


@on_campaign(
    cli.SIMULATOR,
    cli.option("--target", "theta, model or a parameter's name", default="auto"),
    need="simulator",
)
def ask(campaign: Any, target: str) -> Answer:
    """Design the next trial, or show the pending one."""
    trial = campaign.ask(target=target)
    gain, error = trial.expected_gain
    found = {"expected_information_gain": gain, "standard_error": error}
    data = {**trial_of(campaign, trial), **found}
    lines = [f"trial {trial.index}: {place_of(data)}"]
    if not math.isnan(gain):
        lines += [f"it is expected to tell {gain:.2f} nats about {trial.target}"]
    num = math.prod(campaign.x_shape)
    numbers = "--file X.csv" if num > MANY else " ".join("X" * num)
    lines += [f"then: sbi-active tell {campaign.directory} {numbers}"]
    return Answer(data, "\n".join(lines))


@on_campaign(
    *OUTCOME,
    cli.option("--trial", "None is the pending one, or a new one", int, "K"),
    need="record",
)
def tell(campaign: Any, trial: int | None, action: Any, **outcome: Any) -> Answer:
    """Record what a trial gave. X are the numbers, nan for one not measured."""
    x, status = _outcome(campaign, **outcome)
    told = campaign.tell(x, trial=trial, action=action, status=status)
    return _confirmed(campaign, told)


@on_campaign(TRIAL, *OUTCOME, REASON, need="record")
def correct(
    campaign: Any, trial: int, action: Any, reason: str, **outcome: Any
) -> Answer:
    """Replace what was told of a trial."""
    is_of_action = action is not None and not any(outcome.values())
    x, status = (None, "ok") if is_of_action else _outcome(campaign, **outcome)
    what = {"action": action, "status": status, "reason": reason}
    return _confirmed(campaign, campaign.correct(trial, x, **what))


@on_campaign(TRIAL, REASON, need="record")
def withdraw(campaign: Any, trial: int, reason: str) -> Answer:
    """Take a trial out of the belief."""
    return _confirmed(campaign, campaign.withdraw(trial, reason=reason))


def _outcome(
    campaign: Any, *, x: Sequence[str], file: Path | None, **flags: bool
) -> tuple[Any, str]:
    """Return what was measured, in the shape of the simulator's x, and its status."""
    said = [name for name, value in flags.items() if value]
    if len(said) + bool(x) + (file is not None) > 1:
        raise ValueError(
            "expected numbers, --file, --invalid or --missing; got several; write one"
        )
    if said:
        return None, said[0]
    typed = [cli.number_of(text, is_outcome=True) for text in x]
    numbers = typed if file is None else cli.numbers_in(file)
    shape = [*campaign.x_shape]
    if len(numbers) != math.prod(shape) or all(map(math.isnan, numbers)):
        raise ValueError(
            f"expected {math.prod(shape)} numbers, as the simulator gives, and one of "
            f"them measured; got {len(numbers)} ({numbers!s:.80}); write nan for one "
            "that was not measured, --invalid where the trial ran and gave none, which "
            "tells about the parameters, or --missing where it failed"
        )
    return shaped(numbers, shape), "ok"


def _confirmed(campaign: Any, trial: Any) -> Answer:
    data = trial_of(campaign, trial)
    what = f"{data['status']} at {place_of(data)}{numbers_of(data, ', x = ')}"
    text = f"trial {data['trial']}: {what}\nnext: sbi-active ask {campaign.directory}"
    return Answer(data, text)


@on_campaign(need="record")
def status(campaign: Any) -> Answer:
    """Show the trials, the belief and the health."""
    return answer_of(campaign)


@on_campaign(
    cli.SIMULATOR,
    cli.option("--simulator-changed", "take another, compute all again", None),
    need="simulator",
)
def update(campaign: Any) -> Answer:
    """Bring the belief up to date."""
    campaign.update()
    return answer_of(campaign)


@on_campaign(cli.SIMULATOR, cli.EFFECTS, need="simulator")
def adopt(campaign: Any, effects: Sequence[str]) -> Answer:
    """Go on with the effects that a verdict names."""
    from sbi_active.cli.problem import library_of

    report = campaign.criticize(library_of(campaign, effects), evaluate=False)
    campaign.adopt(report)
    if effects:  # let the commands to come find them
        options = read_declared(campaign.directory)
        named = [*options.get("effects", ()), *cli.beside(Path.cwd(), effects)]
        options["effects"] = [*dict.fromkeys(named)]
        write_declared(campaign.directory, **options)
    say(f"adopted: {report.verdict}")
    return answer_of(campaign)


@on_campaign(cli.option("--out", "where to", cli.FILE, "PAGE.html"), need="reader")
def report(campaign: Any, out: Path | None) -> Answer:
    """Write one page that shows the campaign."""
    from sbi_active.campaign.display.page import write_page

    path = write_page(campaign, out or Path(campaign.directory, "report.html"))
    return Answer({"saved": str(path)}, f"saved: {path}")


@on_campaign(
    *(cli.SIMULATOR, cli.SEED),
    cli.option("--netcdf", "where to", cli.FILE, "FILE.nc", required=True),
    need="reader",
)
def export(campaign: Any, netcdf: Path, seed: int) -> Answer:
    """Write belief and trials for ArviZ."""
    from sbi_active import to_inference_data

    if campaign.simulator is None:
        say("note: without predictions and likelihoods; add --simulator, or --trust")
    to_inference_data(campaign, seed=seed).to_netcdf(str(netcdf))
    return Answer({"saved": str(netcdf)}, f"saved: {netcdf}")


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
        request: Any = None
        with contextlib.suppress(ValueError, RecursionError):
            request = json.loads(line)
        if not isinstance(request, dict):
            raise ValueError(
                f'expected a request as {{"command": "ask"}}; got {line.strip()!a:.80};'
                " write one JSON object a line"
            )
        name = {"id": request.pop("id")} if "id" in request else {}
        return {**name, "answer": _called(request, session, given)}
    except Exception as error:
        return {**name, "error": failure(error)}


def _called(
    request: dict[str, Any], session: Session, given: dict[str, Any]
) -> dict[str, Any]:
    name = request.pop("command", None)
    if not isinstance(name, str) or name not in ON_CAMPAIGN:
        raise ValueError(
            f"expected a command among {', '.join(sorted(ON_CAMPAIGN))}; got "
            f'{name!r:.80}; write one of these, as in {{"command": "ask"}}'
        )
    command = ON_CAMPAIGN[name]
    written = cli.named(command, request, "the request")
    if "x" in written:  # numbers of any shape, null for one not measured
        written["x"] = ["nan" if v is None else v for v in flat(written["x"])]
    held = {"default_map": {**given, **written, "folder": session.folder}}
    root = click.get_current_context().find_root()
    with command.make_context(name, [], parent=root, obj=session, **held) as context:
        return command.invoke(context).data
