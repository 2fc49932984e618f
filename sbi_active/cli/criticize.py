"""``sbi-active criticize TRIALS.csv``: what a simulator lacks, from measured trials."""

from __future__ import annotations

import argparse
import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch.distributions import Distribution

from sbi_active.actions import ActionSpace, DiscreteActions
from sbi_active.cli.check import actions_of, numbers_of, prior_of
from sbi_active.cli.loading import load_object
from sbi_active.criticism import Effect, Trials, close_loop, generic_effects
from sbi_active.criticism.tables import WideTable, read_wide_table
from sbi_active.simulation import GaussianNoise, SimulatorModel
from sbi_active.tasks import TASKS, get_task  # pyright: ignore

__all__ = ["add_parser"]


def add_parser(commands: Any) -> None:
    """Add the command to the parser.

    Args:
        commands: What ``ArgumentParser.add_subparsers`` returned.
    """
    criticize = commands.add_parser(
        "criticize",
        help="find what a simulator lacks, from measured trials",
        description=(
            "Compare a simulator with measured trials: find the residual, trace it to "
            "an effect that the simulator lacks, add it, and report the error before "
            "and after. TRIALS.csv has one row a trial, with columns action_* and x_* "
            "and optionally role (fit or 'held out'), index and repeat_of. An empty "
            "cell is what was not measured. All numbers are in the simulator's units; "
            "tables with one row a sample are not read. Write negative numbers as in "
            "--theta-low=-5,-5."
        ),
    )
    criticize.set_defaults(command=_criticize)
    criticize.add_argument("trials", metavar="TRIALS.csv", type=Path)
    source = criticize.add_mutually_exclusive_group(required=True)
    source.add_argument("--task", help=f"one of: {', '.join(TASKS)}")
    source.add_argument("--simulator", metavar="MODULE:FUNCTION")
    criticize.add_argument("--prior", metavar="MODULE:NAME", help="with --simulator")
    criticize.add_argument("--theta-low", metavar="A,B,...", help="in place of --prior")
    criticize.add_argument("--theta-high", metavar="A,B,...")
    criticize.add_argument(
        "--noise",
        metavar="SD[,SD...]",
        help="standard deviation of a measurement, one or one a column of x; without "
        "it, the simulator's own, or that of at least 3 repeats of one action",
    )
    criticize.add_argument(
        "--actions",
        nargs="+",
        metavar="SPEC",
        help="the permitted ones, for the next action: for each entry LOW:HIGH:COUNT "
        "or A,B,...; or one MODULE:NAME",
    )
    criticize.add_argument(
        "--effects",
        metavar="MODULE:NAME",
        help="a list of Effect, or a function that returns one, besides the generic",
    )
    criticize.add_argument(
        "--designed",
        action="store_true",
        help="the actions were chosen for their information",
    )
    criticize.add_argument("--out", type=Path, help="folder for the report")
    criticize.add_argument("--seed", type=int, default=0)


@dataclass(frozen=True)
class _Source:
    """What the trials are compared with; ``actions`` are None where not given."""

    simulator: SimulatorModel
    prior: Distribution
    actions: ActionSpace | None
    effects: list[Effect]


def _criticize(arguments: argparse.Namespace) -> int:
    table = read_wide_table(arguments.trials)
    trials = Trials(**table.arguments)
    source = _source(arguments, table)
    # Only scales are taken from these where the permitted actions are unknown.
    space = source.actions or DiscreteActions(trials.action.unique(dim=0).float())
    own = [*source.effects, *_declared(arguments)]
    taken = {effect.name for effect in own}
    generic = generic_effects(source.simulator, space, prior=source.prior)
    report = close_loop(
        source.simulator,
        source.prior,
        trials,
        effects=[*own, *(e for e in generic if e.name not in taken)],
        actions=source.actions,
        seed=arguments.seed,
        designed=arguments.designed,
    )
    print(report)
    if arguments.out is not None:
        print(f"\nsaved: {report.save(arguments.out)}")
    return 0


def _source(arguments: argparse.Namespace, table: WideTable) -> _Source:
    if arguments.task is not None:
        for name in ("prior", "theta_low", "theta_high"):
            if getattr(arguments, name) is not None:
                raise ValueError(
                    f"expected no --{name.replace('_', '-')} with --task, which has a "
                    f"prior; got {getattr(arguments, name)}; do drop one of them"
                )
        task = get_task(arguments.task)
        actions = actions_of(arguments) if arguments.actions else task.actions
        effects = getattr(task, "effects", list)()
        simulator = _with_noise(task.simulator, arguments.noise)
        return _Source(simulator, task.prior, actions, [*effects])
    fn = load_object(arguments.simulator)
    if not callable(fn):
        raise ValueError(
            f"expected a function or SimulatorModel; got {type(fn).__name__} under "
            f"{arguments.simulator}; do name what takes (theta, action)"
        )
    if not isinstance(fn, SimulatorModel):
        fn = SimulatorModel(fn, channel_names=table.channel_names)
    prior, simulator = prior_of(arguments), _with_noise(fn, arguments.noise)
    actions = actions_of(arguments) if arguments.actions else None
    if isinstance(actions, DiscreteActions) and actions.action_dim == len(
        table.action_names
    ):
        actions = DiscreteActions(
            actions.values, names=table.action_names, units=actions.units
        )
    return _Source(simulator, prior, actions, [])


def _declared(arguments: argparse.Namespace) -> list[Effect]:
    if arguments.effects is None:
        return []
    named: Any = load_object(arguments.effects)
    if callable(named):
        named = named()
    found = [*named]
    wrong = [e for e in found if not isinstance(e, Effect)]
    if wrong:
        raise ValueError(
            f"expected a list of Effect under {arguments.effects}; got "
            f"{type(wrong[0]).__name__} in it; do declare sbi_active.criticism.Effect"
        )
    return found


def _with_noise(model: SimulatorModel, text: str | None) -> SimulatorModel:
    if text is None:
        return model
    sd = numbers_of(text)
    if min(sd) <= 0:
        raise ValueError(
            f"expected --noise > 0; got {text}; do give the standard deviation of a "
            "measurement"
        )
    noisy = copy.copy(model)
    noisy.noise = GaussianNoise(torch.tensor(sd) if len(sd) > 1 else sd[0])
    return noisy
