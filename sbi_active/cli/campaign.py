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
import time
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from shlex import quote
from typing import Any

import click

from sbi_active.campaign.telling import flat, shaped
from sbi_active.cli import declare as cli
from sbi_active.cli import record
from sbi_active.expected import require
from sbi_active.simulation.bank.store import PATIENCE, LockedError, LogChangedError

#: Commands on a campaign by name, which a request may call too.
ON_CAMPAIGN: dict[str, click.Command] = {}


def on_campaign(
    *params: click.Parameter, need: str = "reader"
) -> Callable[[Callable[..., cli.Answer]], click.Command]:
    """Make a function of a campaign and options a command on a folder.

    Args:
        *params: Arguments and options of the command.
        need: Kind of campaign that it works on: "record", trials without torch where
            these suffice; "reader", the campaign as it is read, with its simulator
            where that is named; "simulator", one that simulates.
    """

    def decorate(function: Callable[..., cli.Answer]) -> click.Command:
        @wraps(function)
        def call(folder: Path, simulator: Any = None, noise: Any = None, **how: Any):
            session = click.get_current_context().obj
            session = session or Session(folder, simulator, noise)
            return session.call(function, need, **how)

        more: Any = {"ignore_unknown_options": need == "record"}  # as a minus is one
        shared = [] if need == "record" else [cli.SIMULATOR, cli.NOISE]
        made = cli.command(cli.DIR, *params, *shared, cli.JSON, **more)(call)
        return ON_CAMPAIGN.setdefault(function.__name__, made)

    return decorate


class Session:
    """Calls commands on one campaign, which is loaded again only where it has to be.

    Args:
        folder: Folder of the campaign.
        simulator: Place of the simulator; None is the one that was named before.
        noise: Standard deviation of x, with a simulator that lacks it.
    """

    def __init__(self, folder: Path, simulator: str | None, noise: Any) -> None:
        self.folder, self._place = folder, (folder, simulator, noise)
        self._campaign, self._digest = None, ""

    def call(self, function: Any, need: str, **options: Any) -> cli.Answer:
        """Return the answer of a command; what is told waits while others write.

        Args:
            function: Function of the command.
            need: Kind of campaign that it works on, see :func:`on_campaign`.
            **options: Options of the command, and ``simulator_changed``.
        """
        until = time.monotonic() + PATIENCE
        while need == "record" and time.monotonic() < until:
            with contextlib.suppress(LockedError, LogChangedError):  # before it wrote
                return self._call(function, need, **options)
            time.sleep(0.05)
        return self._call(function, need, **options)

    def _call(
        self, function: Any, need: str, simulator_changed: bool = False, **options: Any
    ) -> cli.Answer:
        is_known = self._digest == record.digest(self.folder)
        campaign: Any = self._campaign if is_known else None
        self._campaign = None  # after an error, too: another process may have written
        if need == "record" and campaign is None:
            with contextlib.suppress(record.Unsure):
                return function(record.Record(self.folder), **options)
        simulates = need == "simulator" or bool(need == "reader" and self._place[1])
        lacks = simulates and getattr(campaign, "simulator", None) is None
        if campaign is None or lacks or simulator_changed:
            from sbi_active.cli.problem import open_campaign

            how: Any = {"simulator_changed": simulator_changed}
            campaign = open_campaign(*self._place, simulates, **how)
        with campaign:  # then others may write
            answer = function(campaign, **options)
            if need == "simulator":
                record.sum_up_campaign(campaign)
        self._campaign, self._digest = campaign, record.digest(self.folder)
        return answer


TARGET = cli.option("--target", "theta, model or a parameter", default="auto")
CHANGED = cli.option("--simulator-changed", "take another, compute all again", None)
NETCDF = cli.option("--netcdf", "where to", cli.FILE, "FILE.nc", required=True)
AT = cli.option("--trial", "by default the pending one, or a new one", int, "K")
TRIAL = cli.argument("trial", "TRIAL", int)
REASON = cli.option("--reason", "kept with the trial", default="")
OUTCOME = [
    cli.argument("x", "[X]...", str, nargs=-1, required=False),
    cli.option("--file", "with the numbers", cli.FILE, "X.csv"),
    cli.option("--invalid", "it ran and gave no measurement", None),
    cli.option("--missing", "a fault that tells nothing hit it", None),
    cli.option("--action", "executed, if another one", cli.NUMBERS, "A,B,..."),
]


@cli.command(
    *(cli.DIR, cli.SIMULATOR, *cli.SPACE),
    cli.option("--names", "of the action's entries", metavar="A,B,..."),
    cli.option("--units", "of the action's entries", metavar="A,B,..."),
    *(cli.METHOD, cli.SEED, cli.SETTINGS, cli.JSON),
)
def init(folder: Path, method: str, seed: int, **given: Any) -> cli.Answer:
    """Make a campaign in a new folder."""
    from sbi_active import Campaign
    from sbi_active.cli.problem import campaign_options, problem_of, remember

    options = campaign_options(given.pop("set"))
    *problem, effects = problem_of(given)
    how: Any = {"method": method, "seed": seed, "options": options, "effects": effects}
    with Campaign(*problem, directory=folder, **how) as campaign:
        remember(folder, simulator=given["simulator"], noise=given["noise"])
        record.sum_up_campaign(campaign)
    then = f"next: sbi-active ask {quote(str(folder))}"
    text = f"{folder}: a campaign of {campaign.actions}\n{then}"
    return cli.Answer({"directory": str(folder)}, text)


@on_campaign(TARGET, need="simulator")
def ask(campaign: Any, target: str) -> cli.Answer:
    """Design the next trial, or show the pending one."""
    trial = campaign.ask(target=target)
    gain, error = trial.expected_gain
    data = record.trial_of(campaign, trial)
    data |= {"expected_information_gain": gain, "standard_error": error}
    tells = "" if math.isnan(gain) else f", expected to tell {gain:.2f} nats"
    data["notes"] = [*getattr(trial.design, "notes", ())]
    lines = [f"trial {trial.index}: {record.place_of(data)}{tells}"]
    lines += [f"note: {note}" for note in data["notes"]]
    then = f"then: sbi-active tell {quote(str(campaign.directory))}"
    return cli.Answer(data, "\n".join([*lines, then]))


@on_campaign(*OUTCOME, AT, need="record")
def tell(campaign: Any, trial: int | None, action: Any, **outcome: Any) -> cli.Answer:
    """Record what a trial gave. X are the numbers, nan for one not measured."""
    x, status = _outcome(campaign, **outcome)
    told = campaign.tell(x, trial=trial, action=action, status=status)
    return record.confirmed(campaign, told)


@on_campaign(TRIAL, *OUTCOME, REASON, need="record")
def correct(
    campaign: Any, trial: int, action: Any, reason: str, **outcome: Any
) -> cli.Answer:
    """Replace what was told of a trial."""
    is_of_action = action is not None and not any(outcome.values())
    x, status = (None, "ok") if is_of_action else _outcome(campaign, **outcome)
    what = {"action": action, "status": status, "reason": reason}
    return record.confirmed(campaign, campaign.correct(trial, x, **what))


@on_campaign(TRIAL, REASON, need="record")
def withdraw(campaign: Any, trial: int, reason: str) -> cli.Answer:
    """Take a trial out of the belief."""
    return record.confirmed(campaign, campaign.withdraw(trial, reason=reason))


def _outcome(
    campaign: Any, x: Sequence[str], file: Path | None, **flags: bool
) -> tuple[Any, str]:
    """Return what was measured, in the shape of the simulator's x, and its status."""
    said = [name for name, value in flags.items() if value]
    is_one = len(said) + bool(x) + (file is not None) < 2
    require(is_one, "numbers, --file, --invalid or --missing", "several", "write one")
    if said:
        return None, said[0]
    if file is not None:
        x = file.read_text("utf-8-sig", "replace").replace(",", " ").split()
    numbers = [cli.number_of(text, is_outcome=True) for text in x]
    num, got = math.prod(campaign.x_shape), f"{len(numbers)} ({numbers!s:.80})"
    is_right = len(numbers) == num and not all(map(math.isnan, numbers))
    advice = "write nan for others; --invalid where it gave none, --missing for a fault"
    require(is_right, f"{num} numbers, one of them measured", got, advice)
    return shaped(numbers, [*campaign.x_shape]), "ok"


@on_campaign(need="record")
def status(campaign: Any) -> cli.Answer:
    """Show the trials, the belief and the health."""
    return record.answer_of(campaign)


@on_campaign(CHANGED, need="simulator")
def update(campaign: Any) -> cli.Answer:
    """Bring the belief up to date."""
    campaign.update()
    return record.answer_of(campaign)


@on_campaign(need="simulator")
def adopt(campaign: Any) -> cli.Answer:
    """Go on with the effects that a verdict names."""
    from sbi_active.cli.problem import library_of

    campaign.adopt(campaign.criticize(library_of(campaign), evaluate=False))
    return record.answer_of(campaign)


@on_campaign(cli.option("--out", "where to", cli.FILE, "PAGE.html"))
def report(campaign: Any, out: Path | None) -> cli.Answer:
    """Write one page that shows the campaign."""
    from sbi_active.display.campaign_page import page

    path = out or Path(campaign.directory, "report.html")
    path.write_text(page(campaign), encoding="utf-8")
    return cli.Answer({"saved": str(path)}, f"saved: {path}")


@on_campaign(cli.SEED, NETCDF)
def export(campaign: Any, netcdf: Path, seed: int) -> cli.Answer:
    """Write belief and trials for ArviZ; predictions too, with --simulator."""
    from sbi_active import to_inference_data

    to_inference_data(campaign, seed=seed).to_netcdf(str(netcdf))
    return cli.Answer({"saved": str(netcdf)}, f"saved: {netcdf}")


@cli.command(cli.DIR, cli.option("--port", "of the page; else a free one", int, "N"))
def watch(folder: Path, port: int | None) -> None:
    """Show a campaign in a browser on this machine while another process runs it."""
    from sbi_active.campaign.watch import server_of

    with server_of(folder, port or 0) as server:
        print(f"open http://127.0.0.1:{server.server_port}, until Ctrl-C", flush=True)
        server.serve_forever()


@cli.command(cli.DIR, cli.SIMULATOR, cli.NOISE)
def serve(folder: Path, simulator: str | None, noise: Any) -> None:
    """Answer requests of a program, a JSON object a line, as {"command": "ask"}.

    They end with standard input. What simulators print goes to standard error.
    """
    session = Session(folder, simulator, noise)
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    with answers, cli.output_to_errors():
        for line in filter(bytes.strip, sys.stdin.buffer):
            name: dict[str, Any] = {}
            try:
                what = "a JSON object a line"
                with cli.misuse(what):  # as one that is nested too deeply
                    request, got = json.loads(line), f"{line.strip()!a:.80}"
                    advice = 'write one, as {"command": "ask"}'
                    require(isinstance(request, dict), what, got, advice)
                    own = {key: request.pop(key) for key in request.keys() & {"id"}}
                    name = json.loads(cli.as_line(own))
                answer = {"answer": _called(session, **request).data}
            except Exception as error:
                answer = {"error": cli.failure(error)}
            print(cli.as_line({**name, **answer}), file=answers, flush=True)


def _called(session: Session, command: Any = None, **given: Any) -> cli.Answer:
    expected = f"a command among {', '.join(sorted(ON_CAMPAIGN))}"
    got, advice = f"{command!r:.80}", "write one of these"
    require(command in [*ON_CAMPAIGN], expected, got, advice)
    found = ON_CAMPAIGN[command]
    names = {param.name for param in found.params} - {"folder", "simulator", "noise"}
    wrong = ", ".join(given.keys() - names)
    require(not wrong, f"options among {', '.join(sorted(names))}", wrong, "correct it")
    root: Any = click.get_current_context().find_root()
    with cli.misuse(f"options of {command}"):  # a number in place of a flag, say
        if given.get("x") is not None:  # of any shape, null for one not measured
            given["x"] = ["nan" if v is None else v for v in flat(given["x"])]
        words = {name: _word(v) for name, v in given.items() if v is not None}
        how: Any = {"parent": root, "default_map": {**words, "folder": session.folder}}
        made = found.make_context(command, [], obj=session, **how)
    with made as context:
        return found.invoke(context)


def _word(value: Any) -> Any:
    """Return a value of a request as it would be typed, 1 of 1.0; lists as they are."""
    if isinstance(value, float):
        return f"{value:.17g}"
    return value if isinstance(value, list) else str(value)
