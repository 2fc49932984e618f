"""What is run, and what is kept of it.

Seeds from 9,000 on belong to the record: nothing else is run on them, and nothing may
be tuned on them.

Measured sets, as problems of the closed loop.

Their files stand beside the project, see each task's ``DATA``; where they are absent, a
case of the record says so.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from types import SimpleNamespace
from typing import Any, get_args

import numpy as np
import torch

from benchmarks.criticism import cases as letters
from benchmarks.criticism.worlds import get_world
from benchmarks.measured import ball_and_hoop, ball_drops, cascaded_tanks
from benchmarks.misfit import cases as misfit
from benchmarks.oracles.calibration import drawn
from sbi_active import BoxActions, Campaign, CampaignOptions
from sbi_active.campaign.options import CampaignDetails
from sbi_active.criticism import Trials, close_loop, identify
from sbi_active.tasks import ball_and_hoop as hoop_task  # pyright: ignore
from sbi_active.tasks import cascaded_tanks as tanks_task  # pyright: ignore
from sbi_active.tasks.servo_pendulum import ServoPendulumTask  # pyright: ignore
from tests.oracles.problem import Problem
from tests.oracles.ways import trials_of


def servo(*, motor_off: int) -> SimpleNamespace:
    """Return the servo, with so many trials whose motor is off."""
    task = ServoPendulumTask()
    off = np.flatnonzero(task.recordings.motor_off).tolist()
    rows = [i for i in range(len(task.recordings)) if i not in off]
    return SimpleNamespace(
        model=task.simulator,
        prior=task.prior,
        trials=task.trials([*rows, *off[:motor_off]], []),
        effects=task.effects(),
    )


def drops(ball: str) -> SimpleNamespace:
    """Return the drops of a ball."""
    task, every = ball_drops, ball_drops.read_drops(ball_drops.DATA)
    return SimpleNamespace(
        model=task.make_simulator(),
        prior=task.make_prior(),
        trials=task.trials_of([drop for drop in every if drop.ball == ball]),
        effects=task.make_effects(),
    )


def bench(task: Any, make: Callable[..., Any]) -> Any:
    """Return a machine with records."""
    return make(task.read_recordings(task.DATA))


MEASURED: dict[str, Callable[[], Any]] = {
    "servo powered": partial(servo, motor_off=0),
    "servo motor off": partial(servo, motor_off=1),
    "hoop": partial(bench, hoop_task, ball_and_hoop.make_bench),
    "tanks": partial(bench, tanks_task, cascaded_tanks.make_bench),
    **{
        f"drops {ball}": partial(drops, ball)
        for ball in ("baseball", "blue_basketball", "golf_ball", "tennis_ball")
    },
}


FIRST_SEED = 9_000
NUM_DRAWS = 2_000
#: Cases of each kind of closed loop, of each campaign and of each problem identified.
NUM_LOOPS, NUM_CAMPAIGNS, NUM_IDENTIFIED = 12, 5, 20
#: Trials that a campaign asks for.
NUM_TRIALS = 3
#: Effective draws that beliefs are taken to rest on. Half widens the errors by 1.4 and
#: hides differences of a third of a deviation; twice calls other seeds different.
EFFECTIVE = 300.0
CAMPAIGNS = (
    *("linear_1_1", "linear_3_10", "linear_7_40", "numerical", "banana", "jump"),
    *("edge", "student"),
)
IDENTIFIED = ("compartments_3", "decay", "missing")


@dataclass
class Result:
    """What is kept of a case.

    Attributes:
        figures: Value and standard error by name; None where nothing is known of it.
        words: Verdict, flags and the like by name.
        cpu_seconds: What the case took.
        rows: Simulated trials.
    """

    figures: dict[str, tuple[float, float | None]] = field(default_factory=dict)
    words: dict[str, str] = field(default_factory=dict)
    cpu_seconds: float = 0.0
    rows: int = 0


def moments(found: Result, name: str, theta: Any, effective: float) -> None:
    """Keep mean and deviation of draws, with their Monte Carlo errors.

    Args:
        found: Where to keep them.
        name: What they are of.
        theta: Shape (n, d).
        effective: Effective draws.
    """
    theta = np.asarray(theta, dtype=float)
    sds = theta.std(0)
    for k, (mean, sd) in enumerate(zip(theta.mean(0), sds, strict=True)):
        found.figures[f"{name} mean {k}"] = float(mean), float(sd / effective**0.5)
        error = float(sd / (2 * effective) ** 0.5)
        found.figures[f"{name} sd {k}"] = float(sd), error


def closed_loop(draw: Callable[[], Any], seed: int) -> Result:
    """Return what the closed loop says of a problem.

    Args:
        draw: Returns its model, prior, trials and effects, and nuisances where there
            are any.
        seed: Seed of the engine.
    """
    problem = draw()
    report = close_loop(
        problem.model,
        problem.prior,
        problem.trials,
        effects=[*problem.effects, *getattr(problem, "nuisances", ())],
        seed=seed,
        evaluate=False,
        plan=False,
    )
    found = Result(words={"verdict": report.verdict})
    found.figures["log Bayes factor"] = report.detection.log_bayes_factor, None
    found.rows = report.num_simulations
    if report.tracing is not None:
        for name, value in report.tracing.inclusion.items():
            found.figures[f"P({name})"] = float(value), None
        for name, fit in report.tracing.evidences.items():
            error = fit.standard_error
            found.figures[f"log Z({name})"] = float(fit.log_evidence), float(error)
        bare = report.tracing.evidences.get("none")
        if bare is not None and len(bare.draws):
            effective = min(max(bare.effective_sample_size, 10.0), len(bare.draws))
            moments(found, "bare", bare.draws, effective)
    return found


def campaign(own: Problem, options: dict[str, Any], seed: int) -> Result:
    """Return what a campaign chooses and believes, trial by trial."""
    counted, num = own.counted()
    low, high = own.action.min(0), own.action.max(0)
    space = BoxActions(low.tolist(), (high + (high <= low)).tolist())
    campaign = Campaign(
        counted.simulator(is_declared=True),
        own.prior,
        space,
        options=CampaignOptions(
            num_samples=400, details=CampaignDetails(num_scored=400), **options
        ),
        seed=seed,
    )
    found, rng = Result(), np.random.default_rng(own.seed)
    for trial in range(NUM_TRIALS):
        action = campaign.ask().action
        x = own.mean(own.truth[None], action.double().numpy()[None])[0]
        x = x + own.error.sample(x.shape, rng)
        campaign.tell(torch.from_numpy(x).float())
        belief: Any = campaign.update()
        theta = belief.sample(torch.Size([NUM_DRAWS])).double().numpy()
        moments(found, f"trial {trial}", theta, EFFECTIVE)
        found.words[f"trial {trial} flag"] = str(belief.diagnostics.trustworthy)
        for k, value in enumerate(action.tolist()):
            found.figures[f"trial {trial} action {k}"] = float(value), None
    found.words["health"] = str(campaign.health)
    found.rows = sum(num)
    return found


def identified(own: Problem, seed: int) -> Result:
    """Return what ``identify`` says of trajectories."""
    counted, num = own.counted()
    action, x = trials_of(own)
    trials = Trials(action, x, sample_times=own.times)
    belief = identify(counted.simulator(is_declared=True), own.prior, trials, seed=seed)
    found = Result(words={"flag": str(belief.diagnostics.trustworthy)})
    moments(found, "belief", belief.draws.double().numpy(), EFFECTIVE)
    found.rows = sum(num)
    return found


def cases() -> dict[str, Callable[[int], Result]]:
    """Return what runs each case, by name: from the engine's seed to a result."""
    found: dict[str, Callable[[int], Result]] = {}
    numbers = range(FIRST_SEED, FIRST_SEED + NUM_LOOPS)
    for number in numbers:
        for world in "ABC":
            for kind in ("clean", "library", "removed", "pair"):
                draw = partial(letters.draw_case, get_world(world), kind, number)
                name = f"loop {world} {kind} {number}"
                found[name] = partial(closed_loop, lambda draw=draw: draw().problem)
        for group in ("own", "letters"):
            for kind in get_args(misfit.Kind):
                draw = partial(misfit.draw_case, group, kind, number)
                name = f"misfit {group} {kind} {number}"
                found[name] = partial(closed_loop, lambda draw=draw: draw().problem)
    for number in range(FIRST_SEED, FIRST_SEED + NUM_CAMPAIGNS):
        for problem in CAMPAIGNS:
            options: dict[str, Any] = {"network": "on demand"}
            if number == FIRST_SEED + NUM_CAMPAIGNS - 1:
                options = {"max_simulations": 600, "planned_trials": NUM_TRIALS}
            name = f"campaign {problem} {number}"
            found[name] = partial(campaign, drawn(problem, number), options)
    for number in range(FIRST_SEED, FIRST_SEED + NUM_IDENTIFIED):
        for problem in IDENTIFIED:
            own = drawn(problem, number)
            found[f"identify {problem} {number}"] = partial(identified, own)
    for name, make in MEASURED.items():
        found[f"measured {name}"] = partial(closed_loop, make)
    return found


def run(case: Callable[[int], Result], seed: int) -> Result:
    """Return the result of a case with a seed of the engine, or its error."""
    start = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.manual_seed(seed)
        try:
            found = case(seed)
        except Exception as error:
            words = f"{type(error).__name__}: {error}"
            found = Result(words={"error": words[:200]})
    spent = time.process_time() - start
    return replace(found, cpu_seconds=round(spent, 2))
