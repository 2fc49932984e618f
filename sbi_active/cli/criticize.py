"""``sbi-active criticize TRIALS``: what a simulator lacks, from measured trials."""

from __future__ import annotations

import inspect
import sys
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from sbi_active.cli import declare as cli
from sbi_active.cli.campaign import Session
from sbi_active.cli.output import Answer

#: Objects that problem.py of a folder of recordings may hold.
NAMED = ("simulator", "prior", "actions", "effects")
#: Arguments of close_loop that are no settings: options have them, or they run trials.
NO_SETTINGS = {
    *NAMED,
    "model",
    "trials",
    "seed",
    "real_system",
    "max_trials",
    "directory",
}
OF_CAMPAIGN = ("simulator", "effects", "out", "trust")
#: Arguments and options that say what is compared with what.
CRITICIZE = [
    cli.argument(
        "trials", "TRIALS.csv", cli.FILE, is_eager=True, callback=cli.take_file
    ),
    *(cli.CONFIG, *cli.PROBLEM, cli.EFFECTS, cli.SEED, cli.TRUST, cli.JSON),
    cli.option(
        "--columns",
        "trial, time, action, x, input, start, role, index or repeat_of where they are "
        "named otherwise, as in trial=ball,drop x=height_m",
        metavar="KEY=NAME[,NAME...] ...",
    ),
    cli.option("--units", "of columns without", metavar="NAME=UNIT ..."),
    cli.option(
        "--order",
        "unknown if not that of rows",
        click.Choice(("known", "unknown")),
        default="known",
    ),
    cli.option("--inputs", "at times of their own", cli.FILE, "INPUTS.csv"),
    cli.option("--set", "of close_loop: warm_up=0.5", metavar="NAME=VALUE ..."),
    cli.option("--out", "folder for the report", cli.FOLDER, "DIR"),
]


@cli.command(*CRITICIZE)
def criticize(trials: Path, **given: Any) -> Answer:
    """Find what a simulator lacks, from measured trials.

    Find the residual, trace it to an effect that the simulator lacks, add it, and
    report the error before and after.

    TRIALS.csv has one row a trial, with columns action_* and x_* and optionally role
    (fit or 'held out'), index and repeat_of; or one row a sample, with columns trial
    and time besides, and with input_* in place of actions that vary in time. start_* is
    a measured start state. Units stand in brackets, as in x_height[m], and are those of
    the simulator. An empty cell is what was not measured. In its place a folder: of a
    campaign, which knows its simulator and its prior, or of recordings, with trials.csv
    or one file *.csv a trial.
    """
    if given["out"] is not None:  # else all is computed before this fails
        given["out"].mkdir(parents=True, exist_ok=True)
    own = (trials / name for name in ("store.db", "campaign.json"))
    if not any(path.exists() for path in own):
        return _compared(trials, given)
    source = click.get_current_context().get_parameter_source
    for name in {*given} - {*OF_CAMPAIGN}:
        if source(name) is not ParameterSource.DEFAULT:
            raise ValueError(
                f"expected --simulator, --effects, --out or --trust for a campaign; "
                f"got --{name.replace('_', '-')}; leave it out, since the campaign in "
                f"{trials} has its own"
            )
    named = {name: given[name] for name in OF_CAMPAIGN}
    return Session(trials).call(_criticized, "simulator", **named)


@cli.command(*CRITICIZE)
def gate(**given: Any) -> Answer:
    """Say whether a simulator may be used, as criticize finds it from the same trials.

    The exit status is 0 for SHIP, 10 for NO_IMPROVEMENT, 11 for NOT_IDENTIFIABLE, 12
    for OUT_OF_PRIOR, 13 for WRONG_MODEL and 14 for NOT_ENOUGH_DATA.
    """
    found = criticize.callback(**given).data["gate"]
    text = f"{found['decision']}: {found['reason']}"
    return Answer(found, text, found["exit_code"])


def _criticized(campaign: Any, effects: list[str], out: Path | None) -> Answer:
    from sbi_active.cli.problem import library_of

    report = campaign.criticize(library_of(campaign, effects))
    named = " ".join(["", "--effects", *effects]) if effects else ""
    adopt = f"to go on with it: sbi-active adopt {campaign.directory}{named}"
    return _answer(report, out, [adopt] if report.tracing.chosen else [])


def _answer(report: Any, out: Path | None, notes: list[str]) -> Answer:
    if out is not None:
        notes = [f"saved: {report.save(out)}", *notes]
    return Answer(report.to_dict(), "\n\n".join([str(report), *notes]))


def _take_module(path: Path, given: dict[str, Any]) -> None:
    """Take objects under the options' own names where no option names them."""
    from sbi_active.cli.problem import load_object

    load_object(f"{path}:__name__")
    is_bounded = given["theta_low"] or given["theta_high"]
    for name in NAMED:
        is_given = given[name] or name == "prior" and is_bounded
        if not is_given and hasattr(sys.modules[path.stem], name):
            value = f"{path}:{name}"
            given[name] = [value] if name in ("actions", "effects") else value


def _compared(path: Path, given: dict[str, Any]) -> Answer:
    """Compare a simulator with the trials of a table, or of a folder of recordings."""
    from sbi_active import DiscreteActions, SimulatorModel
    from sbi_active.cli.problem import problem_of, with_generic, with_noise
    from sbi_active.criticism import Trials, close_loop

    settings = {k: cli.as_json(v) for k, v in cli.pairs_of(given["set"]).items()}
    known = {*inspect.signature(close_loop).parameters} - NO_SETTINGS
    if wrong := {*settings} - known:
        raise ValueError(
            f"expected settings among {', '.join(sorted(known))}; got "
            f"{', '.join(sorted(wrong))}; write one of these"
        )
    module = path / "problem.py"
    if module.is_file() and given["task"] is None:
        _take_module(module, given)
    noise, columns = given.pop("noise"), cli.pairs_of(given["columns"])
    units = cli.pairs_of(given.pop("units"))  # of columns, and not of actions
    model, prior, actions, own = problem_of(given, needs=["prior"])
    trials = Trials.from_csv(
        path,
        columns={key: names.split(",") for key, names in columns.items()} or None,
        units=units,
        order=given["order"],
        inputs=given["inputs"],
    )
    if not isinstance(model, SimulatorModel):
        times, sampled = trials.template()[1], trials.sample_times
        model = SimulatorModel(model, sample_times=times)
        is_ragged = times is not None and bool((sampled != times).any())
        if is_ragged and "times" not in model.conditions:
            raise ValueError(
                "expected a simulator that takes times=, shape (n, k), where trials "
                f"are sampled at different times, as in {path}; got one without; add "
                "it, or give a SimulatorModel with sample_times"
            )
    model = with_noise(model, noise)
    # Only scales are taken from these where the permitted actions are unknown.
    space = actions or DiscreteActions(trials.action.unique(dim=0).float())
    known = space if trials.inputs is None else trials
    report = close_loop(
        model,
        prior,
        trials,
        effects=with_generic(own, model, known, prior),
        actions=actions,
        seed=given["seed"],
        **{"show_progress": sys.stderr.isatty(), **settings},
    )
    labels = [*(trials.action_labels or ())] * (not trials.action_is_label)
    labels += [*(trials.input_labels or ()), *(trials.channel_labels or ())]
    read = f"{len(trials)} trials of {path}: {', '.join(labels)}"
    return _answer(report, given["out"], [read] if labels else [])
