"""``sbi-active check MODULE:FUNCTION``: look a simulator over before a campaign."""

from __future__ import annotations

import argparse
import copy
import math
import sys
import time
import warnings
from dataclasses import replace
from typing import Any

import torch
from sbi.utils import BoxUniform
from torch.distributions import Distribution

from sbi_active.actions import (
    ActionSpace,
    BoxActions,
    DiscreteActions,
    MixedActions,
)
from sbi_active.campaign import Campaign, CampaignOptions
from sbi_active.cli.declared import names_object
from sbi_active.cli.loading import load_object
from sbi_active.seeding import forked_generators
from sbi_active.simulation import GaussianNoise, SimulatorModel, simulate
from sbi_active.simulation.check import check_simulator
from sbi_active.tasks import get_task  # pyright: ignore

MANY_ACTIONS = 50  # that stand for a space without a list, to count simulations
#: Actions of one space. A choice: each is stored in the campaign's folder and takes
#: part in each design; twice as many take twice the memory, and half are still more
#: than any design tells apart.
MOST_ACTIONS = 100_000
#: What float32 holds with all its digits, beside 0.
SMALLEST, LARGEST = torch.finfo(torch.float32).tiny, torch.finfo(torch.float32).max
LONG = 20.0  # seconds of simulation a round, beside which learning counts little


def check(arguments: argparse.Namespace) -> int:
    """Look a simulator over; status 1 where a campaign cannot run."""
    simulator, prior, actions = _source(arguments)
    num_simulations = _campaign_size(actions, arguments.rounds)
    print("sbi-active: running the simulator", file=sys.stderr)
    report = check_simulator(
        simulator,
        prior,
        actions,
        num_rows=arguments.rows,
        num_simulations=num_simulations,
        num_workers=arguments.workers,
        seed=arguments.seed,
    )
    # Where simulations take longer than this, they are what a campaign takes.
    is_short = 60 * (report.minutes or 0.0) <= LONG * arguments.rounds
    if report.is_ready and is_short:
        print("sbi-active: timing a round", file=sys.stderr)
        try:
            seconds = _time_round(simulator, prior, actions, arguments)
            report = replace(report, seconds_round=seconds, num_rounds=arguments.rounds)
        except Exception as error:  # whatever a campaign meets is the finding
            report = replace(report, defects=(f"a round of a campaign fails: {error}",))
    print(report)
    return 0 if report.is_ready else 1


def _time_round(
    simulator: Any, prior: Distribution, actions: ActionSpace, arguments: Any
) -> float:
    """Return wall seconds of a round on an outcome that the prior allows."""
    options = CampaignOptions(num_workers=arguments.workers)
    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the round is thrown away
        campaign = Campaign(
            simulator, prior, actions, seed=arguments.seed, options=options
        )
        action = campaign.ask().action[None]
        with forked_generators(arguments.seed, "truth"):
            theta = prior.sample(torch.Size([1])).float()
        x = simulate(simulator, theta, action, seed=arguments.seed).x[0]
        campaign.tell(x)
        campaign.update()
    return time.perf_counter() - start


def _campaign_size(actions: ActionSpace, num_rounds: int) -> int:
    """Return the most simulations that the default options allow.

    A round trains, designs over all actions, and refines on the trials so far.
    """
    options = CampaignOptions()
    values = getattr(actions, "values", None)
    num_actions = MANY_ACTIONS if values is None else len(values)
    trials = num_rounds * (num_rounds + 1) // 2
    a_round = options.num_simulations + num_actions * options.num_samples
    return num_rounds * a_round + trials * options.refinement.num_histories


def _source(arguments: argparse.Namespace) -> tuple[Any, Distribution, ActionSpace]:
    if (arguments.task is None) == (arguments.simulator is None):
        raise ValueError(
            "expected MODULE:FUNCTION or --task; got both or neither; give one, as "
            "in sbi-active check my_robot.py:simulator"
        )
    if arguments.task is not None:
        task = get_task(arguments.task)
        simulator = with_noise(task.simulator, arguments.noise)
        return simulator, task.prior, task.actions
    simulator = load_object(arguments.simulator)
    if not callable(simulator):
        raise ValueError(
            f"expected a function or SimulatorModel; got {type(simulator).__name__} "
            f"under {arguments.simulator}; name what takes (theta, action)"
        )
    simulator = with_noise(simulator, arguments.noise)
    return simulator, prior_of(arguments), actions_of(arguments)


def prior_of(arguments: argparse.Namespace) -> Distribution:
    """Return the prior that --prior, or --theta-low and --theta-high, name."""
    if arguments.prior is not None:
        prior = load_object(arguments.prior)
        if not isinstance(prior, Distribution):
            raise ValueError(
                "expected a torch distribution; got "
                f"{type(prior).__name__} under {arguments.prior}; name a prior"
            )
        return prior
    if arguments.theta_low is None or arguments.theta_high is None:
        raise ValueError(
            "expected --theta-low and --theta-high, or --prior; got too few; give "
            "bounds as in --theta-low=0,-1 --theta-high=1,1"
        )
    low, high = numbers_of(arguments.theta_low), numbers_of(arguments.theta_high)
    if len(low) != len(high) or any(a >= b for a, b in zip(low, high, strict=True)):
        raise ValueError(
            f"expected as many bounds, low below high; got {low} and {high}; give "
            "one of each a parameter"
        )
    return BoxUniform(torch.tensor(low), torch.tensor(high))


def actions_of(arguments: argparse.Namespace) -> ActionSpace:
    """Return the action space that --actions names."""
    specs = arguments.actions
    if specs is None:
        raise ValueError(
            "expected --actions; got none; write values as in --actions 0:5:11, one "
            "an entry of the action"
        )
    if names_object(specs):
        space = load_object(specs[0])
        if not isinstance(space, ActionSpace):
            raise ValueError(
                f"expected an action space; got {type(space).__name__} under "
                f"{specs[0]}; name one of sbi_active.actions"
            )
        return space
    ranges = [_range(spec) for spec in specs]
    names = [f"action_{k}" for k in range(len(specs))] if len(specs) > 1 else ["action"]
    if None in ranges and ranges.count(None) < len(ranges):
        return MixedActions(
            *[
                DiscreteActions(_axis(spec), names=[name])
                if limits is None
                else BoxActions(*[[limit] for limit in limits], names=[name])
                for spec, limits, name in zip(specs, ranges, names, strict=True)
            ]
        )
    if None not in ranges:
        low, high = zip(*[limits for limits in ranges if limits], strict=True)
        return BoxActions([*low], [*high])
    axes = [torch.tensor(_axis(spec)) for spec in specs]
    _require_few(math.prod(map(len, axes)))
    return DiscreteActions(torch.cartesian_prod(*axes))


def _range(spec: str) -> tuple[float, float] | None:
    """Return the limits that LOW:HIGH writes; None for anything else."""
    if spec.count(":") != 1:
        return None
    low, high = (number_of(part) for part in spec.split(":"))
    return low, high


def _axis(spec: str) -> list[float]:
    parts = spec.split(":")
    if len(parts) == 1:
        return numbers_of(spec)
    if len(parts) != 3 or not parts[2].isdecimal() or int(parts[2]) < 1:
        raise ValueError(
            f"expected LOW:HIGH:COUNT or A,B,...; got {spec!r}; write, say, 0:5:11"
        )
    low, high = (number_of(part) for part in parts[:2])
    _require_few(int(parts[2]))
    return torch.linspace(low, high, int(parts[2])).tolist()


def _require_few(count: int) -> None:
    if count > MOST_ACTIONS:
        raise ValueError(
            f"expected at most {MOST_ACTIONS} actions; got {count}; write LOW:HIGH for "
            "any number between, or a smaller COUNT"
        )


def with_noise(simulator: Any, text: str | None) -> Any:
    """Return a simulator with the Gaussian noise that --noise gives; None for none."""
    if text is None:
        return simulator
    sd = numbers_of(text)
    if min(sd) <= 0:
        raise ValueError(
            f"expected --noise > 0; got {text}; give the standard deviation of a "
            "measurement"
        )
    noise = GaussianNoise(torch.tensor(sd) if len(sd) > 1 else sd[0])
    if not isinstance(simulator, SimulatorModel):
        return SimulatorModel(simulator, noise=noise)
    noisy = copy.copy(simulator)
    noisy.noise = noise
    return noisy


def numbers_of(text: str) -> list[float]:
    """Return finite numbers that are separated by commas."""
    return [number_of(part) for part in text.split(",")]


def number_of(cell: str, place: str = "", *, is_outcome: bool = False) -> float:
    """Return a number as written, which float32 has to hold.

    Args:
        cell: The number; nan in an outcome.
        place: Where it stands, for the error.
        is_outcome: Whether it may be one that was not measured.

    Raises:
        ValueError: If it is anything else.
    """
    try:
        value = math.nan if "_" in cell else float(cell)
    except ValueError:
        value = math.inf
    if value == 0 or SMALLEST <= abs(value) <= LARGEST:
        return value
    if is_outcome and cell.strip().lower() == "nan":
        return math.nan
    raise ValueError(
        f"expected finite numbers; got {cell!r:.80}{place}; write them with a point, "
        "as in 1.5 or 2e-3, without a unit, and within the range of float32"
    )
