"""``sbi-active criticize TRIALS``: what a simulator lacks, from measured trials."""

from __future__ import annotations

import functools
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import torch
from click.core import ParameterSource
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace, DiscreteActions
from sbi_active.campaign.storage.manifest import has_manifest
from sbi_active.cli.given import (
    actions_of,
    effects_of,
    load_object,
    prior_of,
    simulator_of,
    with_generic,
    with_noise,
)
from sbi_active.cli.session import Session
from sbi_active.criticism import Effect, Trials, close_loop
from sbi_active.criticism.data.recordings import read_trials
from sbi_active.criticism.data.table import TrialTable
from sbi_active.criticism.effects.augmented import takes_times
from sbi_active.simulation import SimulatorModel
from sbi_active.simulation.bank.sqlite import NAME
from sbi_active.tasks import get_task  # pyright: ignore

#: What a folder of recordings may hold, and what of its simulator that may name.
MODULE, NAMED = "problem.py", ("simulator", "prior", "actions", "effects")
OF_CAMPAIGN = ("trials", "simulator", "effects", "out", "trust")


def criticize(trials: Path, **options: Any) -> None:
    """Compare a simulator with measured trials, and print the report."""
    given = SimpleNamespace(trials=trials, **options)
    if trials.is_dir():
        if has_manifest(trials):
            return _criticize_campaign(given)
        if not [*trials.glob("*.csv")]:
            raise ValueError(
                f"expected a campaign or recordings in {trials}; got neither "
                f"{NAME} nor a file *.csv; make a campaign by sbi-active init, or "
                "write one table of all trials, or one a trial"
            )
        _take_problem(given)
    if given.task is not None and given.simulator is not None:
        raise ValueError("expected --task or --simulator; got both; drop one of them")
    if given.task is None and given.simulator is None:
        raise ValueError(
            "expected --simulator or --task with a table of trials; got neither; name "
            "it, as in --simulator my_robot.py:simulator, or in problem.toml beside "
            "recordings in a folder"
        )
    table, measured = _trials(given)
    simulator, prior, actions, effects = _source(given, measured)
    # Only scales are taken from these where the permitted actions are unknown.
    space = actions or DiscreteActions(measured.action.unique(dim=0).float())
    over_time = measured.inputs is not None
    own = [*effects, *effects_of([given.effects] if given.effects else [])]
    known = measured if over_time else space
    report = close_loop(
        simulator,
        prior,
        measured,
        effects=with_generic(own, simulator, known, prior),
        actions=actions,
        thin=not given.no_thin,
        seed=given.seed,
        designed=given.designed,
        show_progress=sys.stderr.isatty(),
    )
    print(report)
    if table.columns.time is not None or any(table.columns.units.values()):
        print(f"\n{_described(trials, table, measured)}")
    if given.out is not None:
        print(f"\nsaved: {report.save(given.out)}")
    return None


def _criticize_campaign(given: SimpleNamespace) -> None:
    """Compare a campaign with its own trials; it brings most of what a table lacks."""
    source = click.get_current_context().get_parameter_source
    wrong = [
        name
        for name in vars(given)
        if name not in OF_CAMPAIGN and source(name) is not ParameterSource.DEFAULT
    ]
    if wrong:
        raise ValueError(
            f"expected --simulator, --effects, --out or --trust for a campaign; got "
            f"--{wrong[0].replace('_', '-')}; leave it out, since the campaign in "
            f"{given.trials} has its own"
        )
    options = {name: getattr(given, name) for name in OF_CAMPAIGN[1:]}
    with Session(given.trials) as session:
        session.call("criticize", **options)


def _take_problem(given: SimpleNamespace) -> None:
    """Take from a folder's problem files what the command line leaves out.

    In ``problem.toml``, which was read before, files are those of the folder;
    ``problem.py`` has the objects that are named, under the options' own names.
    """
    source = click.get_current_context().get_parameter_source
    beside = given.trials if given.config is None else given.config.parent
    for name in NAMED:
        if source(name) is ParameterSource.DEFAULT_MAP:
            value = getattr(given, name)
            is_list = not isinstance(value, str)
            within = [_within(beside, word) for word in (value if is_list else [value])]
            setattr(given, name, within if is_list else within[0])
    path = given.trials / MODULE
    if not path.is_file() or given.task is not None:
        return
    load_object(f"{path}:__name__")
    module = sys.modules[path.stem]
    has_bounds = given.theta_low is not None or given.theta_high is not None
    for name in NAMED:
        is_given = getattr(given, name) or name == "prior" and has_bounds
        if not is_given and hasattr(module, name):
            value = f"{path}:{name}"
            setattr(given, name, [value] if name == "actions" else value)


def _within(folder: Path, text: str) -> str:
    """Return what a file names, with the path of files that lie beside it."""
    file, colon, what = text.partition(":")
    beside = file.endswith(".py") and (folder / file).is_file()
    return f"{folder / file}{colon}{what}" if beside else text


def _trials(given: SimpleNamespace) -> tuple[TrialTable, Trials]:
    """Return what the file holds; what it lacks in a small way is noted on stderr."""
    columns = _pairs(given.columns, "--columns")
    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always", UserWarning)
        table = read_trials(
            given.trials,
            columns={key: text.split(",") for key, text in columns.items()} or None,
            units=_pairs(given.units, "--units"),
            inputs=given.inputs,
        )
        trials = Trials(
            **table.arguments, order=given.order, input_hold=given.input_hold
        )
    for note in noted:
        print(f"sbi-active: note: {note.message}", file=sys.stderr)
    num, held = len(trials), len(trials.held_out_positions)
    if num - held < 2:
        raise ValueError(
            f"expected at least two trials to fit; got {num - held} in "
            f"{given.trials} ({num} in all, {held} held out); measure more, "
            "since one trial fits any model"
        )
    return table, trials


def _pairs(texts: Sequence[str], option: str) -> dict[str, str]:
    parts = [text.partition("=") for text in texts]
    for text, (key, _, value) in zip(texts, parts, strict=True):
        if not (key and value):
            raise ValueError(
                f"expected {option} KEY=NAME; got {text!r}; write, say, x=height_m"
            )
    return {key: value for key, _, value in parts}


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


def _source(
    given: SimpleNamespace, trials: Trials
) -> tuple[SimulatorModel, Distribution, ActionSpace | None, list[Effect]]:
    """Return what the trials are compared with."""
    actions = actions_of(given.actions) if given.actions else None
    effects: list[Effect] = []
    if given.task is not None:
        for name in ("prior", "theta_low", "theta_high"):
            if getattr(given, name) is not None:
                raise ValueError(
                    f"expected no --{name.replace('_', '-')} with --task, which has a "
                    f"prior; got {getattr(given, name)}; drop one of them"
                )
        task = get_task(given.task)
        _require_units(task.actions, trials, given.trials)
        actions, effects = actions or task.actions, getattr(task, "effects", list)()
        model, prior = task.simulator, task.prior
    else:
        model = simulator_of(given.simulator, None)
        if not isinstance(model, SimulatorModel):
            model = _with_times(SimulatorModel(model), trials, given)
        prior = prior_of(given.prior, given.theta_low, given.theta_high)
        if actions is not None:
            _require_units(actions, trials, given.trials)
    return with_noise(model, given.noise), prior, actions, [*effects]


def _with_times(
    model: SimulatorModel, trials: Trials, given: SimpleNamespace
) -> SimulatorModel:
    """Return a user's function as the simulator of trials with sample times."""
    times = trials.template()[1]
    if times is None:
        return model
    own = trials.sample_times
    assert own is not None
    ragged = not torch.equal(own.expand(len(trials), -1), times.expand(len(trials), -1))
    if ragged and not takes_times(model):
        raise ValueError(
            "expected a simulator that takes times=, shape (n, k), where trials are "
            f"sampled at different times, as in {given.trials}; got one without "
            f"under {given.simulator}; add it, or give a SimulatorModel with "
            "sample_times"
        )
    fn = model.fn

    @functools.wraps(fn)
    def timed(theta: Tensor, action: Tensor, **keywords: Any) -> Tensor:
        keywords.setdefault("times", times.to(theta).expand(len(theta), -1))
        return fn(theta, action, **keywords)

    return SimulatorModel(timed if takes_times(model) else fn, sample_times=times)


def _require_units(actions: ActionSpace, trials: Trials, path: Path) -> None:
    """Raise where the file states another unit of the action than the simulator."""
    for unit, label in zip(actions.units, trials.action_labels or (), strict=False):
        given = label.partition(" [")[2].removesuffix("]")
        if unit and given and unit != given:
            raise ValueError(
                f"expected actions in {unit}; got {label} in {path}; "
                "convert the column, and state the unit in brackets"
            )
