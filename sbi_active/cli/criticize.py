"""``sbi-active criticize TRIALS``: what a simulator lacks, from measured trials."""

from __future__ import annotations

import inspect
import sys
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from sbi_active.cli import declare as cli
from sbi_active.cli.output import Answer
from sbi_active.cli.session import Session

#: What a folder of recordings may hold, and what of its simulator that may name.
MODULE, NAMED = "problem.py", ("simulator", "prior", "actions", "effects")
#: Arguments of close_loop by which trials are run.
RUN = ("real_system", "max_trials", "directory")
#: Options that say what the trials are compared with.
PROBLEM = (*NAMED, "task", "theta_low", "theta_high")
ORDER = click.Choice(("known", "unknown"))
OF_CAMPAIGN = ("simulator", "effects", "out", "trust")


#: Arguments and options that say what is compared with what.
CRITICIZE = [
    cli.argument("trials", "TRIALS.csv", cli.FILE, **cli.PROBLEM_FILE),
    *(cli.CONFIG, *cli.PROBLEM, cli.EFFECTS, cli.SEED, cli.TRUST, cli.JSON),
    cli.option(
        "--columns",
        "trial, time, action, x, input, start, role, index or repeat_of where they are "
        "named otherwise, as in trial=ball,drop x=height_m",
        cli.PAIRS,
        "KEY=NAME[,NAME...] ...",
    ),
    cli.option("--units", "of columns without", cli.PAIRS, "NAME=UNIT ..."),
    cli.option("--order", "unknown if not that of rows", ORDER, default="known"),
    cli.option("--inputs", "at times of their own", cli.FILE, "INPUTS.csv"),
    cli.option("--set", "of close_loop: warm_up=0.5", cli.PAIRS, "NAME=VALUE ..."),
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
    return _answered(trials, given)


@cli.command(*CRITICIZE)
def gate(trials: Path, **given: Any) -> Answer:
    """Say whether a simulator may be used, as criticize finds it from the same trials.

    The exit status is 0 for SHIP, 10 for NO_IMPROVEMENT, 11 for NOT_IDENTIFIABLE, 12
    for OUT_OF_PRIOR, 13 for WRONG_MODEL and 14 for NOT_ENOUGH_DATA.
    """
    found = _answered(trials, given).data["gate"]
    text = f"{found['decision']}: {found['reason']}"
    return Answer(found, text, found["exit_code"])


def _answered(trials: Path, given: dict[str, Any]) -> Answer:
    from sbi_active.campaign.storage.directory import has_manifest
    from sbi_active.criticism import close_loop

    if given["out"] is not None:  # else all is computed before this fails
        given["out"].mkdir(parents=True, exist_ok=True)
    if trials.is_dir() and has_manifest(trials):
        return _of_campaign(trials, given)
    settings = {k: cli.as_json(v) for k, v in cli.pairs_of(given["set"]).items()}
    known = {*inspect.signature(close_loop).parameters} - {"seed", *NAMED, *RUN}
    if wrong := {*settings} - known:
        raise ValueError(
            f"expected settings among {', '.join(sorted(known))}; got "
            f"{', '.join(sorted(wrong))}; write one of these"
        )
    if trials.is_dir():
        _take_module(trials / MODULE, given)
    return _compared(trials, given, settings)


def _of_campaign(folder: Path, given: dict[str, Any]) -> Answer:
    """Compare a campaign with its own trials; it brings most of what a table lacks."""
    source = click.get_current_context().get_parameter_source
    for name in given:
        if name not in OF_CAMPAIGN and source(name) is not ParameterSource.DEFAULT:
            raise ValueError(
                f"expected --simulator, --effects, --out or --trust for a campaign; "
                f"got --{name.replace('_', '-')}; leave it out, since the campaign in "
                f"{folder} has its own"
            )
    with Session(folder) as session:
        named = {name: given[name] for name in OF_CAMPAIGN}
        return session.call(_criticized, "simulator", **named)


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
    if not path.is_file() or given["task"] is not None:
        return
    from sbi_active.cli.problem import load_object

    load_object(f"{path}:__name__")
    has_bounds = given["theta_low"] is not None or given["theta_high"] is not None
    for name in NAMED:
        is_given = given[name] or name == "prior" and has_bounds
        if not is_given and hasattr(sys.modules[path.stem], name):
            value = f"{path}:{name}"
            given[name] = [value] if isinstance(given[name], list) else value


def _compared(path: Path, given: dict[str, Any], settings: dict[str, Any]) -> Answer:
    """Compare a simulator with the trials of a table, or of a folder of recordings."""
    from sbi_active import DiscreteActions
    from sbi_active.cli.problem import problem_of, with_generic, with_noise
    from sbi_active.criticism import Trials, close_loop

    columns = {k: v.split(",") for k, v in cli.pairs_of(given["columns"]).items()}
    units, options = cli.pairs_of(given["units"]), {k: given[k] for k in PROBLEM}
    model, prior, actions, own = problem_of(options, needs=["prior"])
    how = {"order": given["order"], "inputs": given["inputs"]}
    trials = Trials.from_csv(path, columns=columns or None, units=units, **how)
    labels = trials.action_labels or ()
    for unit, label in zip(actions.units if actions else (), labels, strict=False):
        stated = label.partition(" [")[2].removesuffix("]")
        if unit and stated and unit != stated:
            raise ValueError(
                f"expected actions in {unit}; got {label} in {path}; convert the "
                "column, and state the unit in brackets"
            )
    model = with_noise(_with_times(model, trials, path), given["noise"])
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
    labels = [*labels] * (not trials.action_is_label)
    labels += [*(trials.input_labels or ()), *(trials.channel_labels or ())]
    read = f"{len(trials)} trials of {path}: {', '.join(labels)}"
    return _answer(report, given["out"], [read] if labels else [])


def _with_times(fn: Any, trials: Any, path: Path) -> Any:
    """Return a user's function as the simulator of trials with sample times."""
    from sbi_active import SimulatorModel

    if isinstance(fn, SimulatorModel):
        return fn
    times, sampled = trials.template()[1], trials.sample_times
    model = SimulatorModel(fn, sample_times=times)
    is_ragged = times is not None and bool((sampled != times).any())
    if is_ragged and "times" not in model.conditions:
        raise ValueError(
            "expected a simulator that takes times=, shape (n, k), where trials are "
            f"sampled at different times, as in {path}; got one without; add it, or "
            "give a SimulatorModel with sample_times"
        )
    return model
