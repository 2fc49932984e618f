"""``sbi-active criticize TRIALS``: what a simulator lacks, from measured trials."""

from __future__ import annotations

import functools
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import torch
from click.core import ParameterSource
from torch import Tensor

from sbi_active.actions import ActionSpace, DiscreteActions
from sbi_active.campaign.storage.manifest import has_manifest
from sbi_active.cli.given import (
    effects_of,
    load_object,
    problem_of,
    with_generic,
    with_noise,
)
from sbi_active.cli.output import Answer, say
from sbi_active.cli.session import Session
from sbi_active.criticism import Trials, close_loop
from sbi_active.criticism.data.recordings import read_trials
from sbi_active.criticism.data.table import TrialTable
from sbi_active.simulation import SimulatorModel
from sbi_active.simulation.bank.sqlite import NAME

#: What a folder of recordings may hold, and what of its simulator that may name.
MODULE, NAMED = "problem.py", ("simulator", "prior", "actions", "effects")
#: Options that say what the trials are compared with.
PROBLEM = ("simulator", "task", "prior", "theta_low", "theta_high", "actions")
OF_CAMPAIGN = ("simulator", "effects", "out", "trust")


def criticize(trials: Path, *, json: bool = False, **given: Any) -> Answer | None:
    """Return the report of a comparison of a simulator with measured trials.

    Args:
        trials: Table of trials, folder of recordings, or campaign.
        json: Whether a program asked, which the caller knows how to answer.
        **given: Options by name.
    """
    if trials.is_dir():
        if has_manifest(trials):
            return _criticize_campaign(trials, given)
        if not [*trials.glob("*.csv")]:
            raise ValueError(
                f"expected a campaign or recordings in {trials}; got neither "
                f"{NAME} nor a file *.csv; make a campaign by sbi-active init, or "
                "write one table of all trials, or one a trial"
            )
        _take_module(trials / MODULE, given)
    if given["task"] is None and given["simulator"] is None:
        raise ValueError(
            "expected --simulator or --task with a table of trials; got neither; name "
            "it, as in --simulator my_robot.py:simulator, or in problem.toml beside "
            "recordings in a folder"
        )
    table, measured = _trials(trials, given)
    options = {name: given[name] for name in PROBLEM}
    simulator, prior, actions, effects = problem_of(**options, needs_actions=False)
    if actions is not None:
        _require_units(actions, measured, trials)
    if given["task"] is None and not isinstance(simulator, SimulatorModel):
        simulator = _with_times(SimulatorModel(simulator), measured, trials)
    simulator = with_noise(simulator, given["noise"])
    # Only scales are taken from these where the permitted actions are unknown.
    space = actions or DiscreteActions(measured.action.unique(dim=0).float())
    known = space if measured.inputs is None else measured
    own = [*effects, *effects_of([given["effects"]])]
    if given["out"] is not None:  # else all is computed before this fails
        given["out"].mkdir(parents=True, exist_ok=True)
    report = close_loop(
        simulator,
        prior,
        measured,
        effects=with_generic(own, simulator, known, prior),
        actions=actions,
        thin=not given["no_thin"],
        seed=given["seed"],
        designed=given["designed"],
        show_progress=sys.stderr.isatty(),
    )
    text = [str(report)]
    if table.columns.time is not None or any(table.columns.units.values()):
        text.append(_described(trials, table, measured))
    if given["out"] is not None:
        text.append(f"saved: {report.save(given['out'])}")
    return Answer(report.to_dict(), "\n\n".join(text))


def _criticize_campaign(folder: Path, given: dict[str, Any]) -> Answer | None:
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
        return session.call("criticize", **{name: given[name] for name in OF_CAMPAIGN})


def _take_module(path: Path, given: dict[str, Any]) -> None:
    """Take objects under the options' own names where no option names them."""
    if not path.is_file() or given["task"] is not None:
        return
    load_object(f"{path}:__name__")
    has_bounds = given["theta_low"] is not None or given["theta_high"] is not None
    for name in NAMED:
        is_given = given[name] or name == "prior" and has_bounds
        if not is_given and hasattr(sys.modules[path.stem], name):
            value = f"{path}:{name}"
            given[name] = [value] if name == "actions" else value


def _trials(path: Path, given: dict[str, Any]) -> tuple[TrialTable, Trials]:
    """Return what the file holds; what it lacks in a small way is noted on stderr."""
    columns = _pairs(given["columns"], "--columns")
    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always", UserWarning)
        table = read_trials(
            path,
            columns={key: text.split(",") for key, text in columns.items()} or None,
            units=_pairs(given["units"], "--units"),
            inputs=given["inputs"],
        )
        order = {name: given[name] for name in ("order", "input_hold")}
        trials = Trials(**table.arguments, **order)
    for note in noted:
        say(f"note: {note.message}")
    num, held = len(trials), len(trials.held_out_positions)
    if num - held < 2:
        raise ValueError(
            f"expected at least two trials to fit; got {num - held} in {path} ({num} "
            f"in all, {held} held out); measure more, since one trial fits any model"
        )
    return table, trials


def _pairs(texts: Sequence[str], option: str) -> dict[str, str]:
    found = {}
    for text in texts:
        key, _, value = text.partition("=")
        if not (key and value):
            raise ValueError(
                f"expected {option} KEY=NAME; got {text!r}; write, say, x=height_m"
            )
        found[key] = value
    return found


def _described(path: Path, table: TrialTable, trials: Trials) -> str:
    """Return what was read, with its units."""
    columns = table.columns
    parts = {
        "action": map(columns.label, columns.action),
        "inputs": trials.input_labels or (),
        "x": map(columns.label, columns.x),
    }
    named = {key: ", ".join(names) for key, names in parts.items()}
    what = "; ".join(f"{key} {names}" for key, names in named.items() if names)
    what = f"{len(trials)} trials of {path}: {what}"
    if columns.time is None:
        return what
    counts = trials.mask.flatten(2).any(-1) if trials.x.ndim > 2 else trials.mask
    few, many = int(counts.sum(1).min()), int(counts.sum(1).max())
    return f"{what}; {few} to {many} samples a trial, time [s]"


def _with_times(model: SimulatorModel, trials: Trials, path: Path) -> SimulatorModel:
    """Return a user's function as the simulator of trials with sample times."""
    times = trials.template()[1]
    if times is None:
        return model
    own, fn = trials.sample_times, model.fn
    assert own is not None
    ragged = not torch.equal(own.expand(len(trials), -1), times.expand(len(trials), -1))
    if "times" not in model.conditions:
        if ragged:
            raise ValueError(
                "expected a simulator that takes times=, shape (n, k), where trials "
                f"are sampled at different times, as in {path}; got one without; add "
                "it, or give a SimulatorModel with sample_times"
            )
        return SimulatorModel(fn, sample_times=times)

    @functools.wraps(fn)
    def timed(theta: Tensor, action: Tensor, **keywords: Any) -> Tensor:
        keywords.setdefault("times", times.to(theta).expand(len(theta), -1))
        return fn(theta, action, **keywords)

    return SimulatorModel(timed, sample_times=times)


def _require_units(actions: ActionSpace, trials: Trials, path: Path) -> None:
    """Raise if the file states another unit of the action than the simulator."""
    for unit, label in zip(actions.units, trials.action_labels or (), strict=False):
        given = label.partition(" [")[2].removesuffix("]")
        if unit and given and unit != given:
            raise ValueError(
                f"expected actions in {unit}; got {label} in {path}; "
                "convert the column, and state the unit in brackets"
            )
