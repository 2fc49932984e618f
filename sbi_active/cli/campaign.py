"""Commands on a campaign."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sbi_active.campaign.telling import shaped
from sbi_active.cli import declare as cli
from sbi_active.cli.output import Answer, say
from sbi_active.cli.record import (
    answer_of,
    numbers_of,
    place_of,
    sum_up_campaign,
    trial_of,
)
from sbi_active.cli.session import on_campaign
from sbi_active.cli.trusted import absolute, read_declared, write_declared

MANY = 5  # numbers, more than somebody types
TRIAL = cli.argument("trial", "TRIAL", cli.INTEGER)
REASON = cli.option("--reason", "kept with the trial", default="")
OUTCOME = [
    cli.argument("x", "[X]...", cli.MEASURED, nargs=-1, required=False),
    cli.option("--file", "with the numbers", cli.FILE, "X.csv"),
    cli.option("--invalid", "it ran and gave no measurement", None),
    cli.option("--missing", "a fault that tells nothing hit it", None),
    cli.option("--action", "executed, if another one", cli.NUMBERS, "A,B,..."),
]


@cli.command(
    *(cli.DIR, cli.CONFIG, *cli.PROBLEM, cli.EFFECTS),
    cli.option("--names", "of the action's entries", metavar="A,B,..."),
    cli.option("--units", "of the action's entries", metavar="A,B,..."),
    *(cli.METHOD, cli.SEED, cli.OF_CAMPAIGN),
)
def init(folder: Path, set: list[str], **given: Any) -> None:  # noqa: A002
    """Make a campaign in a new folder, also by --config."""
    from sbi_active import Campaign
    from sbi_active.cli.problem import campaign_options, problem_of

    how = {name: given.pop(name) for name in ("method", "seed")}
    simulator, prior, actions, effects = problem_of(given)
    how |= {"options": campaign_options(set), "directory": folder, "effects": effects}
    with Campaign(simulator, prior, actions, **how) as campaign:
        write_declared(folder, **given)
        sum_up_campaign(campaign)
    print(f"{folder}: a campaign of {actions}\nnext: sbi-active ask {folder}")


@on_campaign(
    cli.SIMULATOR,
    cli.option("--target", "theta, model or a parameter's name", default="auto"),
    need="simulator",
)
def ask(campaign: Any, target: str) -> Answer:
    """Design the next trial, or show the pending one."""
    trial = campaign.ask(target=target)
    gain, error = (v if v == v else None for v in trial.expected_gain)
    found = {"expected_information_gain": gain, "standard_error": error}
    data = {**trial_of(campaign, trial), **found}
    lines = [f"trial {trial.index}: {place_of(data)}"]
    if gain is not None:
        lines += [f"it is expected to tell {gain:.2f} nats about {trial.target}"]
    num = math.prod(campaign.x_shape)
    numbers = "--file X.csv" if num > MANY else " ".join("X" * num)
    lines += [f"then: sbi-active tell {campaign.directory} {numbers}"]
    return Answer(data, "\n".join(lines))


@on_campaign(
    *OUTCOME,
    cli.option("--trial", "None is the pending one, or a new one", cli.INTEGER, "K"),
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
    campaign: Any, *, x: Sequence[float], file: Path | None, **flags: bool
) -> tuple[Any, str]:
    """Return what was measured, in the shape of the simulator's x, and its status."""
    said = [name for name, value in flags.items() if value]
    if len(said) + bool(x) + (file is not None) > 1:
        raise ValueError(
            "expected numbers, --file, --invalid or --missing; got several; write one"
        )
    if said:
        return None, said[0]
    numbers = [*x] if file is None else cli.numbers_in(file)
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


@on_campaign(need="repair")
def repair(campaign: Any) -> Answer:
    """Give up what is damaged, and say what that is."""
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
def adopt(campaign: Any, effects: list[str]) -> Answer:
    """Go on with the effects that a verdict names."""
    from sbi_active.cli.problem import library_of

    report = campaign.criticize(library_of(campaign, effects), evaluate=False)
    campaign.adopt(report)
    if effects:  # let the commands to come find them
        options = read_declared(campaign.directory)
        named = dict.fromkeys([*options.get("effects", ()), *map(absolute, effects)])
        write_declared(campaign.directory, **{**options, "effects": [*named]})
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
        say(
            "note: without predictions and likelihoods, for which the simulator runs: "
            "add --simulator, or --trust"
        )
    to_inference_data(campaign, seed=seed).to_netcdf(str(netcdf))
    return Answer({"saved": str(netcdf)}, f"saved: {netcdf}")
