"""Whether the library computes what it computed, to the last bit.

    python -m benchmarks bits            # compares with figures.json
    python -m benchmarks bits --write    # writes it anew

Some thirty short runs over all parts: campaigns of each method, the gain by each
estimator, refinement of smooth and of rough responses, verdicts of the closed loop, a
push of a box, the engine. Each gives a digest of every number that it made, and a few
of them in full. Whoever moves code about runs it before and after; a difference is
explained in the commit that makes it, with the figures against the exact limit beside.

Digests depend on the versions of torch, NumPy and SciPy and on the processor, which
stand in the file: on another machine, write it anew before a change.
"""

from __future__ import annotations

import hashlib
import json
import platform
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from attrs import evolve
from sbi.utils import BoxUniform
from torch import Tensor

from benchmarks.criticism.cases import draw_case
from benchmarks.criticism.worlds import get_world
from sbi_active import (
    ALHI,
    ASBI,
    BoxActions,
    Campaign,
    CampaignOptions,
    DiscreteActions,
    GaussianNoise,
    InformationGainDesigner,
    MixtureDensity,
    RefinementOptions,
    SeqBED,
    SimulatorModel,
    simulate,
)
from sbi_active.campaign.options import CampaignDetails
from sbi_active.criticism import generic_effects
from sbi_active.inference.rounds.rows import Observation
from sbi_active.seeding import forked_generators, row_normals
from sbi_active.tasks import get_task

FIGURES = Path(__file__).with_name("figures.json")
#: Of a run that differs: the last bit of some sums depends on where an array lies.
NUM_REPEATS = 3
PACKAGES = ("torch", "numpy", "scipy", "scikit-learn", "sbi", "mujoco")
SMALL = CampaignOptions(
    num_simulations=600,
    num_samples=200,
    density_estimator=MixtureDensity(num_iterations=60),
    details=CampaignDetails(num_scored=200),
)
CURVES: dict[str, Callable[[Tensor], Tensor]] = {
    "linear": lambda t: t,
    "sinh": lambda t: 5 * torch.sinh(t / 2.5) / 3.6,
    "square": lambda t: t**2 / 2.5 - 5,
    "jump": lambda t: 5 * torch.sign(t) + 0.4 * t,
}
BOX = BoxUniform(-5 * torch.ones(2), 5 * torch.ones(2))

Run = Callable[[], list[Any]]


def response(variant: str) -> Callable[[Tensor, Tensor], Tensor]:
    """Return the numerical model's noise-free outcome, with a curve of theta."""

    def mean(theta: Tensor, action: Tensor) -> Tensor:
        bent = CURVES[variant](theta[:, :1]) * torch.exp(3 - action)
        return bent + theta[:, 1:] * action

    return mean


def seeded(theta: Tensor, action: Tensor, *, seeds: Tensor) -> Tensor:
    """Return draws of the numerical model, each row a function of its seed."""
    return response("linear")(theta, action) + row_normals(seeds, 1).float()


def campaign(method: str) -> list[Any]:
    """Return what two rounds of a campaign chose, saw, scored and believe."""
    task = get_task("numerical")
    options = SMALL
    if method == "seqbed":
        options = evolve(SMALL, density_estimator=CampaignOptions().density_estimator)
    given = {"method": method, "seed": 3, "options": options}
    run = Campaign(task.simulator, task.prior, task.actions, **given)
    with forked_generators(4):
        run.run(task.real_system, num_rounds=2)
    with forked_generators(0):
        draws = run.belief.sample(torch.Size([64]))
    trials = [[t.action, t.x, t.surprise, t.log_score] for t in run.history]
    gains = [t.design.expected_information_gain for t in run.history if t.design]
    return [draws.mean(0), draws, trials, gains]


def gain(estimator: str) -> list[Any]:
    """Return a design by an estimator, on a model that was trained for it."""
    actions = DiscreteActions(torch.arange(-5, 5.5, 2.5))
    simulator = SimulatorModel(response("linear"), noise=GaussianNoise(1.0))
    network = MixtureDensity(num_iterations=60)
    model = None
    if estimator not in ("entropy", "nested"):
        if estimator in ("ratio", "info_nce"):
            inference: Any = SeqBED(BOX, show_progress_bars=False)
        else:
            make = ALHI if estimator == "likelihood" else ASBI
            inference = make(BOX, network, show_progress_bars=False)
        with forked_generators(1):
            theta, action = BOX.sample((600,)), actions.sample((600,), seed=1)
            x = simulator(theta, action)
            inference.append_simulations(theta, x, action=action, belief=BOX).train()
            model = inference.build_posterior()
    if estimator == "variational_nested":
        estimator = "auto"
    designer = InformationGainDesigner(actions, num_samples=200, estimator=estimator)
    design = designer.select(model, simulator, belief=BOX, seed=2)
    return [design.expected_information_gain, design.standard_error, design.action]


def continuous() -> list[Any]:
    """Return a design in a box of actions."""
    simulator = SimulatorModel(response("linear"), noise=GaussianNoise(1.0))
    box = BoxActions(torch.tensor([-5.0]), torch.tensor([5.0]))
    designer = InformationGainDesigner(box, num_samples=100)
    design = designer.select(None, simulator, belief=BOX, seed=2)
    return [design.expected_information_gain, design.candidates]


def refinement(variant: str, *, declared: bool) -> list[Any]:
    """Return draws of a refined belief of three trials."""
    known = SimulatorModel(response(variant), noise=GaussianNoise(1.0))

    def plain(theta: Tensor, action: Tensor) -> Tensor:
        return known(theta, action)

    truth = torch.tensor([[-3.0, 1.0]])
    action = torch.tensor([[-2.0], [2.0], [5.0]])
    with forked_generators(5):
        x = response(variant)(truth.expand(3, -1), action) + torch.randn(3, 1)
    inference = ASBI(BOX, show_progress_bars=False)
    trials = [Observation(*trial) for trial in zip(action, x, strict=True)]
    simulator = known if declared else plain
    belief = inference.update_all(trials, simulator=simulator, seed=7)
    with forked_generators(0):
        draws = belief.sample(torch.Size([64]))
    return [draws.mean(0), draws, belief.log_prob(draws)]


def many(num_parameters: int) -> list[Any]:
    """Return draws of a belief of many parameters, with numbers that are missing."""
    with forked_generators(6):
        weight = torch.randn(num_parameters, 30)
        x = torch.randn(1, num_parameters) @ weight + torch.randn(2, 30)
    x[0, 20:] = torch.nan

    def simulator(theta: Tensor, action: Tensor) -> Tensor:
        return action * (theta @ weight) + torch.randn(len(theta), 30)

    prior = BoxUniform(-3 * torch.ones(num_parameters), 3 * torch.ones(num_parameters))
    inference = ASBI(prior, show_progress_bars=False)
    trials = [Observation(torch.ones(1), row) for row in x]
    settings = RefinementOptions(num_histories=600, num_effective=50)
    given = {"simulator": simulator, "seed": 7, "refinement": settings}
    belief = inference.update_all(trials, **given)
    with forked_generators(0):
        draws = belief.sample(torch.Size([64]))
    return [draws.mean(0), draws, belief.log_prob(draws)]


def adoption() -> list[Any]:
    """Return a campaign before and after it adopts an effect."""
    problem = draw_case(get_world("A"), "library", 1, num_trials=8).problem
    options = evolve(SMALL, refinement=RefinementOptions(num_histories=400))
    given = {"effects": problem.effects, "seed": 1, "options": options}
    run = Campaign(problem.model, problem.prior, get_world("A").actions, **given)
    trials = problem.trials
    for action, x in zip(trials.action[:6], trials.x[:6], strict=True):
        run.tell(x, action=action)
    run.tell(status="missing", action=trials.action[6])
    run.update()
    report = run.criticize()
    run.adopt(report)
    run.withdraw(2)
    run.update()
    with forked_generators(0):
        draws = run.belief.sample(torch.Size([64]))
    scores = [[t.surprise, t.misfit, t.information_gained] for t in run.history]
    return [report.verdict, draws, scores, run.health]


def verdict(world: str, kind: Any, number: int) -> list[Any]:
    """Return the probabilities of a report and its error before and after."""
    problem = draw_case(get_world(world), kind, number, num_trials=8).problem
    report = problem.report(number, plan=False)
    table = report.before_after
    return [
        report.verdict,
        [f"{k}={v!r}" for k, v in sorted(report.probabilities.items())],
        None if table is None else table[["before", "after"]].to_numpy(float),
    ]


def plan() -> list[Any]:
    """Return the next action of a report, with generic effects."""
    task = get_task("numerical")
    problem = draw_case(get_world("A"), "library", 2, num_trials=8).problem
    effects = generic_effects(problem.model, task.actions, prior=problem.prior)
    report = problem.report(0, effects=effects)
    found = report.next_action
    assert found is not None
    groups = sorted(map(sorted, found.inseparable))  # a set is printed in any order
    return [report.verdict, str(replace(found, inseparable=())), str(groups)]


def box() -> list[Any]:
    """Return pushes of the box in MuJoCo."""
    task = get_task("box_collision")
    with forked_generators(0):
        theta = task.prior.sample((40,))
    action = task.actions.sample((40,), seed=0)
    rows = simulate(task.simulator, theta, action, seed=1)
    return [rows.x, rows.theta]


def engine(num_workers: int) -> list[Any]:
    """Return rows of the engine, by seeds and by the global generator."""
    with forked_generators(0):
        theta = BOX.sample((1_000,))
    action = torch.linspace(-5, 5, 1_000)[:, None]
    by_seeds = simulate(seeded, theta, action, seed=0, workers=num_workers)
    task = get_task("numerical")
    by_blocks = simulate(task.simulator, theta, action, seed=0, workers=num_workers)
    return [by_seeds.x, by_blocks.x]


def runs() -> Iterator[tuple[str, Run]]:
    """Yield the runs by name."""
    for method in ("asbi", "nsbi", "alhi", "nlhi", "seqbed"):
        yield f"campaign, {method}", lambda m=method: campaign(m)
    for name in ("entropy", "nested", "posterior", "likelihood", "ratio", "info_nce"):
        yield f"gain, {name}", lambda n=name: gain(n)
    yield "gain, variational_nested", lambda: gain("variational_nested")
    yield "gain in a box", continuous
    for variant in CURVES:
        yield f"refinement, {variant}", lambda v=variant: refinement(v, declared=False)
    yield "refinement, jump, declared noise", lambda: refinement("jump", declared=True)
    for number in (4, 12):
        yield f"refinement, {number} parameters", lambda d=number: many(d)
    yield "adoption", adoption
    for world, numbers in (("A", (0, 1)), ("B", (0, 1)), ("C", (0,))):
        for case in product((world,), ("clean", "library"), numbers):
            name = "verdict, {} {} {}".format(*case)
            yield name, lambda own=case: verdict(*own)
    yield "next action", plan
    yield "box", box
    for workers in (1, 2):
        yield f"engine, {workers} workers", lambda w=workers: engine(w)


def numbers(value: Any) -> Iterator[bytes]:
    """Yield all that a run made as bytes."""
    if isinstance(value, list | tuple):
        for each in value:
            yield from numbers(each)
    elif isinstance(value, Tensor | np.ndarray):
        array = np.ascontiguousarray(torch.as_tensor(value).detach().numpy())
        yield f"{array.dtype} {array.shape} ".encode() + array.tobytes()
    else:
        yield repr(value).encode()


def figures(made: list[Any]) -> dict[str, Any]:
    """Return the digest of what a run made, and its first entry to be read."""
    digest = hashlib.sha256(b"|".join(numbers(made))).hexdigest()
    first = made[0]
    shown = str(first.flatten().tolist()[:4] if isinstance(first, Tensor) else first)
    return {"digest": digest, "first": shown}


def environment() -> dict[str, str]:
    """Return what the digests depend on."""
    found = {name: version(name) for name in PACKAGES}
    return found | {"python": platform.python_version(), "machine": platform.machine()}


def main(*, write: bool = False, only: str = "") -> int:
    """Run all and compare, or write.

    Args:
        write: Whether to write the figures anew.
        only: Names, or parts of names, that are run; all by default.
    """
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    known = json.loads(FIGURES.read_text()) if FIGURES.exists() else {"runs": {}}
    made, different = dict(known["runs"]), []
    for name, run in runs():
        if only not in name:
            continue
        start = time.process_time()
        made[name] = figures(run())
        for _ in range(0 if write else NUM_REPEATS):
            if known["runs"].get(name) == made[name]:
                break
            made[name] = figures(run())
        same = known["runs"].get(name) == made[name]
        different += [] if same else [name]
        seconds = time.process_time() - start
        print(f"{name}: {'same' if same else 'DIFFERS'}, {seconds:.1f} CPU s")
    if write:
        ordered = {name: made[name] for name, _ in runs()}
        text = {"environment": environment(), "runs": ordered}
        FIGURES.write_text(json.dumps(text, indent=1) + "\n")
        return 0
    if different and known.get("environment") != environment():
        print(f"written with {known.get('environment')}; got {environment()}")
    print(f"{len(different)} of {len(made)} runs differ")
    return 1 if different else 0
