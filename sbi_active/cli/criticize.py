"""``sbi-active criticize TRIALS``: what a simulator lacks, from measured trials."""

from __future__ import annotations

import argparse
import functools
import sys
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace, DiscreteActions
from sbi_active.campaign.storage.manifest import has_manifest
from sbi_active.cli import campaign
from sbi_active.cli.check import actions_of, prior_of, with_noise
from sbi_active.cli.folder import effects_of, read_config
from sbi_active.cli.loading import load_object
from sbi_active.cli.problem import read_problem
from sbi_active.criticism import Effect, Trials, close_loop, generic_effects
from sbi_active.criticism.data.recordings import read_trials
from sbi_active.criticism.data.table import TrialTable
from sbi_active.criticism.effects.augmented import takes_times
from sbi_active.simulation import SimulatorModel
from sbi_active.simulation.bank.sqlite import NAME
from sbi_active.tasks import get_task  # pyright: ignore


def criticize(arguments: argparse.Namespace) -> int:
    """Compare a simulator with measured trials, and print the report."""
    if arguments.trials.is_dir():
        if has_manifest(arguments.trials):
            return _criticize_campaign(arguments)
        if not [*arguments.trials.glob("*.csv")]:
            raise ValueError(
                f"expected a campaign or recordings in {arguments.trials}; got neither "
                f"{NAME} nor a file *.csv; make a campaign by sbi-active init, or "
                "write one table of all trials, or one a trial"
            )
        read_problem(arguments)
    elif arguments.config is not None:
        read_config(arguments)
    if arguments.task is None and arguments.simulator is None:
        raise ValueError(
            "expected --simulator or --task with a table of trials; got neither; name "
            "it, as in --simulator my_robot.py:simulator, or in problem.toml beside "
            "recordings in a folder"
        )
    table, trials = _trials(arguments)
    simulator, prior, actions, effects = _source(arguments, trials)
    # Only scales are taken from these where the permitted actions are unknown.
    space = actions or DiscreteActions(trials.action.unique(dim=0).float())
    over_time = trials.inputs is not None
    own = [*effects, *effects_of(_named_effects(arguments))]
    taken = {effect.name for effect in own}
    generic = generic_effects(simulator, trials if over_time else space, prior=prior)
    report = close_loop(
        simulator,
        prior,
        trials,
        effects=[*own, *(e for e in generic if e.name not in taken)],
        actions=actions,
        thin=not arguments.no_thin,
        seed=arguments.seed,
        designed=arguments.designed,
        show_progress=sys.stderr.isatty(),
    )
    print(report)
    if table.columns.time is not None or any(table.columns.units.values()):
        print(f"\n{_described(arguments.trials, table, trials)}")
    if arguments.out is not None:
        print(f"\nsaved: {report.save(arguments.out)}")
    return 0


def _criticize_campaign(arguments: argparse.Namespace) -> int:
    """Compare a campaign with its own trials; it brings most of what a table lacks."""
    taken = ("trials", "simulator", "effects", "out", "trust", "command", "parser")
    given = {k: v for k, v in vars(arguments).items() if k not in taken}
    wrong = [k for k, v in given.items() if v != arguments.parser.get_default(k)]
    if wrong:
        raise ValueError(
            f"expected --simulator, --effects, --out or --trust for a campaign; got "
            f"--{wrong[0].replace('_', '-')}; leave it out, since the campaign in "
            f"{arguments.trials} has its own"
        )
    arguments.folder = arguments.trials
    return campaign.criticize(arguments)


def _named_effects(arguments: argparse.Namespace) -> list[str]:
    return [] if arguments.effects is None else [arguments.effects]


def _trials(arguments: argparse.Namespace) -> tuple[TrialTable, Trials]:
    """Return what the file holds; what it lacks in a small way is noted on stderr."""
    columns = _pairs(arguments.columns, "--columns")
    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always", UserWarning)
        table = read_trials(
            arguments.trials,
            columns={key: text.split(",") for key, text in columns.items()} or None,
            units=_pairs(arguments.units, "--units"),
            inputs=arguments.inputs,
        )
        trials = Trials(
            **table.arguments,
            order=arguments.order,
            input_hold=arguments.input_hold,
        )
    for note in noted:
        print(f"sbi-active: note: {note.message}", file=sys.stderr)
    num, held = len(trials), len(trials.held_out_positions)
    if num - held < 2:
        raise ValueError(
            f"expected at least two trials to fit; got {num - held} in "
            f"{arguments.trials} ({num} in all, {held} held out); measure more, "
            "since one trial fits any model"
        )
    return table, trials


def _pairs(texts: list[str] | None, option: str) -> dict[str, str]:
    found = {}
    for text in texts or []:
        key, equals, value = text.partition("=")
        if not (key and equals and value):
            raise ValueError(
                f"expected {option} KEY=NAME; got {text!r}; write, say, x=height_m"
            )
        found[key] = value
    return found


def _described(path: Path, table: TrialTable, trials: Trials) -> str:
    """Return what was read, with its units."""
    columns, num = table.columns, len(trials)
    parts = {
        "action": map(columns.label, columns.action),
        "inputs": trials.input_labels or (),
        "x": map(columns.label, columns.x),
    }
    named = {key: ", ".join(names) for key, names in parts.items()}
    what = "; ".join(f"{key} {names}" for key, names in named.items() if names)
    what = f"{num} trials of {path}: {what}"
    if columns.time is None:
        return what
    counts = trials.mask.flatten(2).any(-1) if trials.x.ndim > 2 else trials.mask
    few, many = int(counts.sum(1).min()), int(counts.sum(1).max())
    return f"{what}; {few} to {many} samples a trial, time [s]"


def _source(
    arguments: argparse.Namespace, trials: Trials
) -> tuple[SimulatorModel, Distribution, ActionSpace | None, list[Effect]]:
    """Return what the trials are compared with."""
    if arguments.task is not None:
        for name in ("prior", "theta_low", "theta_high"):
            if getattr(arguments, name) is not None:
                raise ValueError(
                    f"expected no --{name.replace('_', '-')} with --task, which has a "
                    f"prior; got {getattr(arguments, name)}; drop one of them"
                )
        task = get_task(arguments.task)
        _require_units(task.actions, trials, arguments)
        actions = actions_of(arguments) if arguments.actions else task.actions
        effects = getattr(task, "effects", list)()
        simulator = with_noise(task.simulator, arguments.noise)
        return simulator, task.prior, actions, [*effects]
    fn = load_object(arguments.simulator)
    if not callable(fn):
        raise ValueError(
            f"expected a function or SimulatorModel; got {type(fn).__name__} under "
            f"{arguments.simulator}; name what takes (theta, action)"
        )
    if not isinstance(fn, SimulatorModel):
        fn = _with_times(SimulatorModel(fn), trials, arguments)
    prior, simulator = prior_of(arguments), with_noise(fn, arguments.noise)
    actions = actions_of(arguments) if arguments.actions else None
    if actions is not None:
        _require_units(actions, trials, arguments)
    return simulator, prior, actions, []


def _with_times(
    model: SimulatorModel, trials: Trials, arguments: argparse.Namespace
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
            f"sampled at different times, as in {arguments.trials}; got one without "
            f"under {arguments.simulator}; add it, or give a SimulatorModel with "
            "sample_times"
        )
    fn = model.fn

    @functools.wraps(fn)
    def timed(theta: Tensor, action: Tensor, **keywords: Any) -> Tensor:
        keywords.setdefault("times", times.to(theta).expand(len(theta), -1))
        return fn(theta, action, **keywords)

    return SimulatorModel(timed if takes_times(model) else fn, sample_times=times)


def _require_units(
    actions: ActionSpace, trials: Trials, arguments: argparse.Namespace
) -> None:
    """Raise where the file states another unit of the action than the simulator."""
    for unit, label in zip(actions.units, trials.action_labels or (), strict=False):
        given = label.partition(" [")[2].removesuffix("]")
        if unit and given and unit != given:
            raise ValueError(
                f"expected actions in {unit}; got {label} in {arguments.trials}; "
                "convert the column, and state the unit in brackets"
            )
