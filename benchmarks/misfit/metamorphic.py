"""Whether a verdict stays the same where what changes is not data.

    python -m benchmarks misfit.metamorphic --cases 5200 5240
    python -m benchmarks misfit.metamorphic --summary

A case of :mod:`benchmarks.misfit.cases`, its kind by turns, is judged as it is and
again after each change: "irrelevant", four more declared effects that explain nothing;
"units", outcomes in thousandths of their unit; "finer", the sensor declared ten times
finer than it is; "denser", four times as many samples of the same trials, where there
are any, of a sensor with twice the error, so that together they tell as much; "order",
the effects declared in the opposite order. The same names are due.
With a finer sensor a clean case misses it, which is true; its names are due
nevertheless.

Cases below 1,000 are for tuning, those from 1,000 on judge. Resumable: a case that
stands in the CSV file is not run again.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.criticism.problem import named
from benchmarks.criticism.worlds.world import effect, normal
from benchmarks.misfit.cases import Case, Kind, Problem, draw_case
from benchmarks.misfit.machines import GROUPS, get_machine
from benchmarks.rows import benchmark
from sbi_active.criticism import Effect
from sbi_active.display.table import Table
from sbi_active.seeding import derive_seed, forked_generators

RESULT = Path(__file__).parent / "results" / "metamorphic.csv"

#: Kinds by turns; E and R, whose names are hardest, as often as all others.
KINDS: tuple[Kind, ...] = ("E", "R", "P", "E", "R", "CE", "E", "R", "M", "C")
UNIT, FINER, DENSER = 1000.0, 10.0, 4
IRRELEVANT = 4


def irrelevant(case: Case) -> Problem:
    """Return the problem with four effects that explain nothing."""
    problem, sd = case.problem, case.truth.machine.noise_sd

    def pattern(seed: int) -> Effect:
        def apply(x: Tensor, phi: Tensor, action: Tensor, context: Any) -> Tensor:
            with forked_generators(derive_seed(seed, "irrelevant")):
                signs = 2.0 * torch.randint(2, (97, *x.shape[1:])).to(x) - 1
            each = phi.reshape(-1, *[1] * (x.ndim - 1))
            return x + sd * each * signs[context.index.long() % 97]

        own = effect(f"pattern {seed}", "observation", normal(1.0), apply)
        return replace(own, family="pattern")

    more = [pattern(k) for k in range(IRRELEVANT)]
    return replace(problem, effects=[*problem.effects, *more])


def units(case: Case) -> Problem:
    """Return the problem with outcomes in thousandths of their unit."""
    problem, truth = case.problem, case.truth
    fn, t = problem.model.fn, problem.trials

    def scaled(theta: Tensor, action: Tensor, **options: Any) -> Tensor:
        return UNIT * fn(theta, action, **options)

    scaled.__signature__ = inspect.signature(fn)  # type: ignore[attr-defined]
    sd = UNIT * truth.machine.noise_sd
    model = replace(truth.machine, fn=scaled, noise_sd=sd).model()
    trials = truth.trials(UNIT * t.x, problem.model.sample_times)
    effects = [_in_units(own) for own in problem.effects]
    return replace(problem, model=model, trials=trials, effects=effects)


def finer(case: Case) -> Problem:
    """Return the problem with a sensor declared finer than it is."""
    machine = case.truth.machine
    model = replace(machine, noise_sd=machine.noise_sd / FINER).model()
    return replace(case.problem, model=model)


def denser(case: Case) -> Problem | None:
    """Return the problem with more samples that tell as much; None if it has none."""
    truth = case.truth
    what = truth.discrepancy
    if truth.machine.name not in GROUPS["own"]:
        return None
    if what is not None and what.kind == "process":  # it was drawn sample by sample
        return None
    num_trials, num_samples = truth.machine.num_trials, truth.error.shape[1]
    machine = get_machine(truth.machine.name, (num_trials, DENSER * num_samples))
    machine = replace(machine, noise_sd=DENSER**0.5 * machine.noise_sd)
    # Independent errors of this size, whose mean over each sample's is what it had.
    shape = *truth.error.shape[:2], DENSER, *truth.error.shape[2:]
    with forked_generators(derive_seed(len(truth.action), "denser")):
        error = machine.noise_sd * torch.randn(shape, dtype=torch.float64)
    error = error - error.mean(2, keepdim=True) + truth.error[:, :, None]
    kept = {own.name for own in case.problem.effects}
    more = replace(
        truth,
        machine=machine,
        error=error.flatten(1, 2),
        effects=tuple(machine.effect(name) for name in truth.names),
    )
    return Problem(
        model=machine.model(),
        prior=machine.prior,
        trials=more.trials(times=machine.times),
        effects=[own for own in machine.library if own.name in kept],
    )


def order(case: Case) -> Problem:
    """Return the problem with its effects in the opposite order."""
    return replace(case.problem, effects=case.problem.effects[::-1])


CHANGES: dict[str, Callable[[Case], Problem | None]] = {
    "none": lambda case: case.problem,
    "irrelevant": irrelevant,
    "units": units,
    "finer": finer,
    "denser": denser,
    "order": order,
}


def _in_units(own: Effect) -> Effect:
    """Return an effect whose outcomes are in other units."""
    if own.hook != "observation":
        return own

    def apply(x: Tensor, phi: Tensor, action: Tensor, context: Any) -> Tensor:
        return UNIT * own.apply(x / UNIT, phi, action, context)

    return replace(own, apply=apply)


def table(rows: Sequence[Mapping[str, str]]) -> str:
    """Return how often the names stay, by change."""
    names, helps = (
        {
            (r["group"], r["kind"], r["case"], r["change"]): frozenset(
                json.loads(r[column])
            )
            for r in rows
        }
        for column in ("named", "helps")
    )
    cells = []
    for change in [name for name in CHANGES if name != "none"]:
        keys = [key for key in names if key[3] == change]
        bases = [(*key[:3], "none") for key in keys]
        same, alike = (
            sum(of[k] == of[b] for k, b in zip(keys, bases, strict=True))
            for of in (names, helps)
        )
        cells.append((change, f"{same}/{len(keys)}", f"{alike}/{len(keys)}"))
    return Table(("change", "same names", "same helps"), cells).markdown()


@lru_cache(1)
def drawn(number: int) -> tuple[str, Kind, Case]:
    """Return the group, the kind and the case of a number."""
    group = [*GROUPS][number // len(KINDS) % len(GROUPS)]
    kind = KINDS[number % len(KINDS)]
    return group, kind, draw_case(group, kind, number)


def row_of(number: int, change: str) -> Sequence[Mapping[str, object]]:
    """Return the row of a verdict after a change; none where it cannot be made."""
    group, kind, case = drawn(number)
    if (problem := CHANGES[change](case)) is None:
        return []
    report = problem.report(number, evaluate=False, plan=False)
    found = {"named": named(report), "helps": report.tracing.chosen}
    row = {"group": group, "machine": case.truth.machine.name, "kind": kind}
    return [row | {k: json.dumps(sorted(names)) for k, names in found.items()}]


main = benchmark(RESULT, row_of, table, case=range(5_200, 5_240), change=CHANGES)
