"""What three chosen trials do to a verdict, beside random and spread-out ones.

    python -m benchmarks experiments --cases 6110 6122
    python -m benchmarks experiments --summary

The machines, the effects and what nobody declared are those of the misfit benchmark, of
its kinds E (the cause is declared), R (the cause is removed from the library) and C
(clean, for what the loop costs where nothing is missing: chosen trials alone); B is
world B of the criticism benchmark with a cause of its library, most of which have near
twins, and "B outside" with one that it never had. All designs take trials from the same
32 permitted actions, drawn as the actions of the trials were, or (``--reach 1.5``) up
to half of that range farther from its middle, as a machine's limits are wider than what
was tried: "chosen" by ``close_loop(real_system=)``, "random", "spread out" (farthest
from all before); "none" is the verdict before any.

Seeds are the numbers of cases. **Those from 6,000 on judge**, and no other benchmark
has them; those below are for tuning. Resumable: one row of JSON a case and
design, in benchmarks/experiments/results.jsonl. The groups of machines take turns.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from benchmarks.criticism.cases import draw_case as draw_in_world
from benchmarks.criticism.intervals import rate
from benchmarks.criticism.problem import Problem, named
from benchmarks.criticism.worlds import get_world
from benchmarks.misfit.cases import draw_case
from benchmarks.misfit.truth import Truth
from benchmarks.rows import benchmark
from sbi_active import DiscreteActions
from sbi_active.arrays import distance_from
from sbi_active.criticism import Report, close_loop
from sbi_active.criticism.experiments.settle import with_trial
from sbi_active.display.table import Table
from sbi_active.seeding import derive_seed, forked_generators

#: Permitted actions of a case.
NUM_PERMITTED = 32
Kind = Literal["E", "R", "C", "B", "B outside"]
KINDS: tuple[Kind, ...] = get_args(Kind)
OUTSIDE = "B outside"
#: What the refitted bare model has to miss to be counted, in noise variances.
SUPPORTED = 25.0
#: A cause that removes as much of the error is a large one, as in the misfit benchmark.
LARGE = 0.5


@dataclass
class Reality:
    """The truth of a case, one trial after another.

    Attributes:
        problem: What the loop is given.
        right: Names that are right.
        observe: Function from an action and the place of a trial to what is measured.
        actions: Permitted actions.
        index: Place of the next trial.
        size: What the refitted bare model misses, in noise variances; NaN if unknown.
        gain: Share of the bare model's error on held-out trials that the refitted cause
            removes, beside the misfit that nobody declared; NaN if unknown.
    """

    problem: Problem
    right: frozenset[str]
    observe: Callable[[Tensor, int], Tensor]
    actions: DiscreteActions
    index: int
    size: float = float("nan")
    gain: float = float("nan")

    @classmethod
    def of(cls, number: int, kind: Kind, reach: float) -> Reality:
        """Return the reality of a case before any further trial.

        Args:
            number: Number of the case.
            kind: One of the kinds.
            reach: Range of the permitted actions, in times that of the trials. An entry
                that has one sign keeps it.
        """
        make = _in_world_b if kind.startswith("B") else _beside_misfit
        own, draw, tried = make(number, kind)
        with forked_generators(derive_seed(number, "permitted")):
            permitted = draw(NUM_PERMITTED)
        low, high = (end.to(permitted) for end in (tried.min(0)[0], tried.max(0)[0]))
        middle = (low + high) / 2
        wide = middle + reach * (permitted - middle)
        wide = wide.clamp(min=torch.where(low < 0, -torch.inf, 0.0))
        wide = wide.clamp(max=torch.where(high > 0, torch.inf, 0.0))
        return cls(**own, actions=DiscreteActions(wide))

    def run(self, action: Tensor) -> Tensor:
        """Return what the sensor reads at an action."""
        self.index += 1
        return self.observe(action, self.index - 1)


#: Parts of a reality, a function that draws actions, and the actions of the trials.
Made = tuple[dict[str, Any], Callable[[int], Tensor], Tensor]


def _beside_misfit(number: int, kind: Any) -> Made:
    """Return a case of the misfit benchmark.

    A trial has the discrepancy that was drawn for its place in the order of execution;
    after the last place, that of an early trial that was held out.
    """
    case = draw_case(("own", "letters")[number % 2], kind, number)
    truth = case.truth
    right = frozenset().union(*[truth.machine.equivalent(n) for n in truth.names])

    def observe(action: Tensor, k: int) -> Tensor:
        longer = _long_enough(truth, k)
        actions = longer.action.clone()
        actions[k] = action.to(actions)
        what = _at(longer, actions, k)
        found = replace(longer, action=actions, discrepancy=what)
        return found.measured(torch.tensor([k]))[0]

    index = int(truth.fitted.max()) + 1
    own = {"problem": case.problem, "right": right, "observe": observe, "index": index}
    if kind == "E":
        cause = [e for e in case.problem.effects if e.name in truth.names]
        errors = [truth.held_out_error(effects) for effects in (cause, [])]
        own |= {"gain": round(1 - errors[0] / errors[1], 3)}
    return own, truth.machine.draw_actions, truth.action


def _in_world_b(number: int, kind: str) -> Made:
    """Return a case of world B, whose cause is in the library, or outside of it."""
    world = get_world("B")
    case = draw_in_world(world, "outside" if kind == OUTSIDE else "library", number)
    truth = case.truth

    def observe(action: Tensor, k: int) -> Tensor:
        return truth.observe(action[None].float(), torch.tensor([k]))[0]

    right = frozenset().union(*[world.equivalent(n) for n in truth.names])
    index, size = len(case.problem.trials), truth.non_centrality
    own = {"problem": case.problem, "right": right, "observe": observe, "index": index}
    return own | {"size": size}, lambda num: world.actions.sample((num,)), truth.action


def _long_enough(truth: Truth, k: int) -> Truth:
    """Return the truth with places up to one of this index."""
    n = len(truth.action)
    more = max(k + 1 - n, 0)
    if not more:
        return truth
    early = truth.held_out[:more]
    changed: dict[str, Any] = {"action": torch.cat([truth.action, truth.action[early]])}
    with forked_generators(derive_seed(n, "sensor", truth.machine.name)):
        error = torch.randn(more, *truth.error.shape[1:], dtype=torch.float64)
    changed["error"] = torch.cat([truth.error, truth.machine.noise_sd * error])
    what = truth.discrepancy
    if what is not None and len(what.series) == n and what.series.shape[1]:
        series = torch.cat([what.series, what.series[early]])
        changed["discrepancy"] = replace(what, series=series)
    return replace(truth, **changed)


def _at(truth: Truth, actions: Tensor, k: int):
    """Return the discrepancy where trial k has another action than was drawn for it.

    Without a time axis a process follows the action: between those drawn it is linear.
    """
    what = truth.discrepancy
    if what is None or what.kind != "process" or truth.machine.times is not None:
        return what
    drawn = [i for i in range(len(truth.action)) if i != k]
    drawn.sort(key=lambda i: float(truth.action[i, 0]))
    place, value = truth.action[drawn, 0].numpy(), what.series[drawn, 0].numpy()
    series = what.series.clone()
    series[k, 0] = float(np.interp(float(actions[k, 0]), place, value))
    return replace(what, series=series)


def spread_out(reality: Reality, num: int) -> Tensor:
    """Return the permitted actions that are farthest from all others, one by one.

    Args:
        reality: Reality, whose trials were run already.
        num: Number of actions.
    """
    values, tried = reality.actions.values, [*reality.problem.trials.fit.action]
    for _ in range(num):
        distance = distance_from(torch.stack(tried), values)
        tried.append(values[int(distance.argmax())])
    return torch.stack(tried[-num:])


RESULTS = Path(__file__).parent / "results.jsonl"
DESIGNS = ("chosen", "random", "spread out")
NUM_TRIALS = 3
NO_NAMES = {"none", "unexplained", "scatter", "outlier"}

Row = dict[str, Any]


def verdict_of(reality: Reality, number: int, design: str) -> Report:
    """Return the report after the trials of a design.

    Args:
        reality: The truth of the case.
        number: Number of the case, also the loop's seed.
        design: One of the designs.
    """
    problem = reality.problem
    options: dict[str, Any] = {"effects": problem.effects, "evaluate": False}
    options |= {"plan": False, "seed": number, "actions": reality.actions}
    given, trials = (problem.model, problem.prior), problem.trials
    if design == "chosen":
        run = {"real_system": reality.run, "max_trials": NUM_TRIALS}
        return close_loop(*given, trials, **options, **run)
    if design == "spread out":
        actions = spread_out(reality, NUM_TRIALS)
    else:
        gen = torch.Generator().manual_seed(derive_seed(number, "random"))
        values = reality.actions.values
        actions = values[torch.randperm(len(values), generator=gen)[:NUM_TRIALS]]
    for action in actions:
        x = reality.run(action).numpy()
        trials = with_trial(problem.model, trials, action.double().numpy(), x)
    return close_loop(*given, trials, **options)


def row_of(number: int, kind: Kind, design: str, reach: float) -> Row:
    """Return the row of one case, design and range of permitted actions."""
    reality = Reality.of(number, kind, reach)
    right = sorted(reality.right) if kind in ("E", "B") else []
    start = time.process_time()
    report = verdict_of(reality, number, design)
    tested = [
        {"before": trial.verdict, "held": bool(trial.held)} for trial in report.tested
    ]
    return {
        "size": reality.size,
        "gain": reality.gain,
        "right": right,
        "verdict": report.verdict,
        "named": [*named(report)],
        "trials": len(tested) if design == "chosen" else NUM_TRIALS,
        "tested": tested,
        "cpu_seconds": round(time.process_time() - start, 1),
    }


def lines_of(rows: Sequence[Row]) -> str:
    """Return the lines of the summary, each design over the cases that it has."""
    failed = [row for row in rows if row.get("failure")]
    # NaN where it is not known: by construction these can be told.
    kept = [
        r for r in rows if not (r.get("failure") or r.get("size", np.nan) <= SUPPORTED)
    ]
    clean = [row for row in kept if row["kind"] == "C"]
    chosen = [row for row in kept if row["design"] == "chosen" and row["kind"] != "C"]
    cells = []
    reaches = sorted({row["reach"] for row in kept if row["kind"] != "C"})
    for reach, design in product(reaches, ("none", *DESIGNS)):
        own = [row for row in kept if row["design"] == design]
        own = [*map(_before, chosen)] if design == "none" else own
        own = [row for row in own if row["reach"] == reach and row["kind"] != "C"]
        if not own:
            continue
        e, r, b, out = (
            [x for x in own if x["kind"] == k] for k in ("E", "R", "B", OUTSIDE)
        )
        large = [x for x in e if x["gain"] >= LARGE]
        trials = sum(row["trials"] for row in own) / len(own)
        seconds = sum(row["cpu_seconds"] for row in own) / len(own)
        shares = [rate([_is_right(row) for row in part]) for part in (large, e, b)]
        wrong = rate([not {*row["named"]} <= {*row["right"]} for row in e])
        alias = [rate([bool(row["named"]) for row in part]) for part in (r, out)]
        ends = f"{trials:.1f}", f"{seconds:.0f}"
        of_e, of_b = (*shares[:2], wrong), (shares[2], alias[1])
        cells.append((reach, design, *of_e, alias[0], *of_b, *ends))
    names = "reach", "design", "E, gain >= 50 %: right", "E: right"
    names += "E: a wrong name", "R: an alias"
    names += "B: right", "B outside: an alias", "trials", "CPU s"
    lines = [f"{len(kept)} rows; {len(failed)} failed", ""]
    lines += [Table(names, cells).markdown(), ""]
    tested = [(trial, row) for row in chosen for trial in row["tested"]]
    parts: dict[str, list[bool]] = {}
    for trial, row in tested:
        named = {*trial["before"].split(" + ")}
        nothing = NO_NAMES & named
        kind = "right names" if named <= {*row["right"]} else "a wrong name"
        parts.setdefault("no name" if nothing else kind, []).append(trial["held"])
    lines += [f"90 % predictions after {k} held: {rate(v)}" for k, v in parts.items()]
    few = rate([row["trials"] <= 1 for row in clean])
    alarms = rate([row["verdict"] != "none" for row in clean])
    lines += [f"clean: one further trial at most: {few}; another verdict: {alarms}"]
    return "\n".join(lines)


def _before(chosen: Row) -> Row:
    """Return the row of the verdict before any trial, from that of the chosen ones."""
    if not chosen["tested"]:
        return chosen | {"cpu_seconds": float("nan")}
    verdict = chosen["tested"][0]["before"]
    named = [] if verdict in NO_NAMES else verdict.split(" + ")
    unknown = {"cpu_seconds": float("nan"), "trials": 0}
    return chosen | {"verdict": verdict, "named": named} | unknown


def _is_right(row: Row) -> bool:
    return bool(row["named"]) and {*row["named"]} <= {*row["right"]}


main = benchmark(
    RESULTS,
    row_of,
    lines_of,
    may_fail=True,
    skip=lambda case, kind, design, reach: kind == "C" and design != "chosen",
    case=range(6_000, 6_122),
    kind=KINDS,
    design=DESIGNS,
    reach=(1.0, 1.5),
)
