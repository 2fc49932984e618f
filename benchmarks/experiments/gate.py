"""What the gate decides of five machines in five conditions.

    python -m benchmarks experiments.gate --seeds 7000 7008
    python -m benchmarks experiments.gate --summary

Clean trials of the misfit benchmark's machines, as many held out as fitted, and its
library; conditions differ in one thing each:

- right: nothing;
- wrong effect: one declared effect is missing, of one to six sensor deviations;
- unidentifiable: the first parameter that is positive is a product of two;
- prior too narrow: a parameter's prior is a third as wide and ends short of the truth,
  by five or more of the deviations by which the trials tell that parameter;
- too few data: two trials are fitted, of so few numbers that they leave a parameter
  wider than .7 of its prior by their Fisher information, and three are held out; or,
  with an odd seed, four are fitted and one is held out.

Only the first should ship. **Seeds from 7,000 on judge**; those below are for tuning.
Resumable: one row of JSON a set, in benchmarks/experiments/gate.jsonl.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.criticism.intervals import rate
from benchmarks.misfit.cases import draw_case
from benchmarks.misfit.machines import GROUPS
from benchmarks.misfit.machines.machine import Machine, box
from benchmarks.misfit.truth import Truth
from benchmarks.rows import benchmark
from sbi_active.criticism import Trials, close_loop
from sbi_active.criticism.data import Role
from sbi_active.display.table import Table
from sbi_active.seeding import derive_seed, forked_generators

RESULTS = Path(__file__).parent / "gate.jsonl"
MACHINES = ("pendulum", "spring", "tanks", "B", "C")
EXPECTED = {
    "right": "SHIP",
    "wrong effect": "WRONG_MODEL",
    "unidentifiable": "NOT_IDENTIFIABLE",
    "prior too narrow": "OUT_OF_PRIOR",
    "too few data": "NOT_ENOUGH_DATA",
}
DIFFERENCE = 1e-5  # of a parameter's range
NARROW = 1 / 3  # of the width of a prior
DEVIATIONS = 5.0  # by which a narrow prior ends short of the truth, at least
OPEN = 0.7  # share of a prior's deviation that few trials leave

Row = dict[str, Any]


def told(truth: Truth, rows: Tensor, samples: int | None = None) -> Tensor:
    """Return the deviation of each parameter by Fisher information and prior, (d,).

    Args:
        truth: The truth of a clean case.
        rows: Positions of the trials.
        samples: Numbers of each trial that count; None takes all.
    """
    machine, theta = truth.machine, truth.theta
    width = _width(machine)
    steps = DIFFERENCE * width * torch.eye(len(width), dtype=torch.float64)

    def read(at: Tensor) -> Tensor:
        n = len(at)
        x = machine.fn(
            at.repeat_interleave(len(rows), 0), truth.action[rows].repeat(n, 1)
        )
        return x.reshape(n, len(rows), -1)[..., :samples].reshape(n, -1)

    slope = (read(theta + steps) - read(theta - steps)) / (2 * DIFFERENCE)
    slope = slope / machine.noise_sd  # of parameters in units of their range
    precision = slope @ slope.T + 12 * torch.eye(len(width), dtype=torch.float64)
    return torch.linalg.inv(precision).diagonal().sqrt() * width


def _width(machine: Machine) -> Tensor:
    low, high = _ends(machine)
    return high - low


def _ends(machine: Machine) -> tuple[Tensor, Tensor]:
    base = machine.prior.base_dist
    return base.low.double(), base.high.double()


def unidentifiable(machine: Machine) -> Machine:
    """Return the machine with its first positive parameter as a product."""
    low, high = _ends(machine)
    j = int((low > 0).nonzero()[0])
    fn = machine.fn

    @wraps(fn)
    def product(theta: Tensor, action: Tensor, **given: Any) -> Tensor:
        own = theta[:, :-1].clone()
        own[:, j] = own[:, j] * theta[:, -1]
        return fn(own, action, **given)

    ends = [*zip(low.tolist(), high.tolist(), strict=True), (0.5, 2.0)]
    ends[j] = (float(low[j]) / 2, float(high[j]) * 2)
    names = (*machine.parameter_names, "factor")
    return replace(machine, fn=product, prior=box(*ends), parameter_names=names)


def too_narrow(truth: Truth) -> Machine | None:
    """Return the machine with a prior that ends short of the truth."""
    machine, (low, high) = truth.machine, _ends(truth.machine)
    sd, width = told(truth, truth.fitted), _width(truth.machine)
    place = ((truth.theta[0] - low) / width).tolist()
    for j in torch.randperm(len(width)).tolist():
        is_below = place[j] > 0.5
        gap = (place[j] if is_below else 1 - place[j]) - NARROW
        if gap * width[j] < DEVIATIONS * sd[j]:
            continue
        ends = [*zip(low.tolist(), high.tolist(), strict=True)]
        part = NARROW * float(width[j])
        first, last = ends[j]
        ends[j] = (first, first + part) if is_below else (last - part, last)
        return replace(machine, prior=box(*ends))
    return None


def case_of(name: str, condition: str, seed: int) -> tuple[Machine, Trials] | None:
    """Return a machine and its trials in a condition; None where it cannot be had.

    Args:
        name: Name of the machine.
        condition: One of the conditions.
        seed: Seed of the set.
    """
    (group,) = [g for g, names in GROUPS.items() if name in names]
    place, num = GROUPS[group].index(name), len(GROUPS[group])
    number = num * seed + place  # machines and layouts go round with the number
    kind = "CE" if condition == "wrong effect" else "C"
    truth = draw_case(group, kind, number).truth
    machine, fitted, held_out = truth.machine, truth.fitted, truth.held_out
    samples: int | None = None
    if condition == "unidentifiable":
        machine = unidentifiable(machine)
    elif condition == "prior too narrow":
        with forked_generators(derive_seed(seed, "narrow", name)):
            narrow = too_narrow(truth)
        if narrow is None:
            return None
        machine = narrow
    elif condition == "too few data" and seed % 2:
        fitted, held_out = fitted[:4], held_out[:1]
    elif condition == "too few data":
        fitted, held_out = fitted[:2], held_out[:3]
        prior = _width(machine) / 12**0.5
        numbers = truth.error[0].numel()
        enough = (
            k
            for k in range(numbers, 0, -1)
            if (told(truth, fitted, k) > OPEN * prior).any()
        )
        samples = next(enough, 1)
    rows = torch.cat([fitted, held_out])
    x = truth.measured(rows)
    if samples is not None:
        flat = x.reshape(len(x), -1).clone()
        flat[:, samples:] = float("nan")
        x = flat.reshape(x.shape)
    fit: list[Role] = ["fit"]
    other: list[Role] = ["held out"]
    trials = Trials(
        truth.action[rows],
        x,
        role=fit * len(fitted) + other * len(held_out),
        index=rows,
        sample_times=machine.times if machine.declares_times else None,
    )
    return machine, trials


def row_of(name: str, condition: str, seed: int) -> Row:
    """Return the row of one set."""
    case = case_of(name, condition, seed)
    if case is None:
        return {"decision": ""}
    machine, trials = case
    start = time.process_time()
    effects = [*machine.library]
    given = machine.model(), machine.prior, trials
    gate = close_loop(*given, effects=effects, plan=False, seed=seed).gate
    return {
        "decision": gate.decision,
        "reason": gate.reason,
        "cpu_seconds": round(time.process_time() - start, 1),
    }


def lines_of(rows: Sequence[Row]) -> str:
    """Return the table of decisions by condition."""
    failed = [row for row in rows if row.get("failure")]
    rows = [row for row in rows if row.get("decision")]
    decisions = [*dict.fromkeys([*EXPECTED.values(), "NO_IMPROVEMENT"])]
    cells = []
    for condition, expected in EXPECTED.items():
        own = [row["decision"] for row in rows if row["condition"] == condition]
        count = Counter(own)
        ends = rate([decision == expected for decision in own])
        cells.append((condition, *[str(count[d]) for d in decisions], ends))
    wrong = [row["decision"] for row in rows if row["condition"] != "right"]
    seconds = [row["cpu_seconds"] for row in rows]
    mean = sum(seconds) / max(len(seconds), 1)
    table = Table(("condition", *decisions, "as expected"), cells).markdown()
    said = f"false SHIP: {rate([d == 'SHIP' for d in wrong])}; {mean:.0f} CPU s a set"
    return f"{len(rows)} sets; {len(failed)} failed\n\n{table}\n\n{said}"


main = benchmark(
    RESULTS,
    row_of,
    lines_of,
    may_fail=True,
    machine=MACHINES,
    condition=[*EXPECTED],
    seed=range(7_000, 7_008),
)
