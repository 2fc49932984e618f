"""Draw a machine's truth, and hand over its trials alone.

Kinds: E, an effect of the library beside an undeclared discrepancy; R, the same case
with the effect (and what is equivalent to it) removed from the library; M, the
discrepancy alone; P, a fast and a slow effect beside it; C, clean; CE, an effect and
no discrepancy. Sizes are root mean squares that the refitted bare model leaves: 2 to 10
sensor deviations for a discrepancy, 1 to 6 times as much for an effect.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Uniform

from benchmarks.criticism.problem import Problem
from benchmarks.misfit.discrepancies import draw_discrepancy, one
from benchmarks.misfit.machines import GROUPS, LAYOUTS, Machine, get_machine
from benchmarks.misfit.machines.machine import is_positive, scale_of
from benchmarks.misfit.truth import LARGEST, Setup, Truth
from sbi_active.criticism import Effect
from sbi_active.seeding import derive_seed, forked_generators

Kind = Literal["E", "R", "M", "P", "C", "CE"]
KINDS: tuple[Kind, ...] = get_args(Kind)
#: Seeds below are for tuning; those from here on judge, and nothing is tuned on them.
FIRST_JUDGED = 1_000
SIZES = 2.0, 10.0  # of a discrepancy, sensor deviations
RATIO = 1.0, 6.0  # of an effect to the discrepancy, or to one sensor deviation
MOST = 2e3  # sensor deviations that a discrepancy may make anywhere
FARTHEST = 1.0  # standard deviation of the logarithm of what wanders
NUM_DRAWS = 12  # of a strength that has no null to grow from


@dataclass(frozen=True)
class Case:
    """A problem and its truth."""

    problem: Problem
    truth: Truth


def draw_case(group: str, kind: Kind, number: int) -> Case:
    """Draw one case.

    Args:
        group: "own" or "letters"; machine and layout go round with the number.
        kind: See the module; E and R of the same number are the same truth.
        number: Of the case, also its seed.
    """
    names = GROUPS[group]
    layout = LAYOUTS[number // len(names) % len(LAYOUTS)]
    machine = get_machine(names[number % len(names)], layout)
    drawn = "E" if kind == "R" else kind
    seed = derive_seed(number, "misfit", machine.name, drawn)
    is_judged = number >= FIRST_JUDGED
    attempts = (
        _draw(machine, kind, derive_seed(seed, "attempt", k), is_judged=is_judged)
        for k in count()
    )
    truth = next(truth for truth in attempts if truth is not None)
    library = [*machine.library]
    if kind == "R":
        gone = frozenset().union(*[machine.equivalent(n) for n in truth.names])
        library = [effect for effect in library if effect.name not in gone]
    trials = truth.trials(times=machine.times if machine.declares_times else None)
    problem = Problem(
        model=machine.model(), prior=machine.prior, trials=trials, effects=library
    )
    return Case(problem, truth)


def _draw(machine: Machine, kind: Kind, seed: int, *, is_judged: bool) -> Truth | None:
    """Return a truth, or None where a size cannot be had."""
    with forked_generators(seed):
        return _drawn(machine, kind, is_judged=is_judged)


def _drawn(machine: Machine, kind: Kind, *, is_judged: bool) -> Truth | None:
    num = 2 * machine.num_trials
    theta = machine.prior.sample((1,)).double()
    action = machine.draw_actions(num)
    fitted = torch.randperm(num)[: machine.num_trials].sort().values
    setup = Setup(machine=machine, theta=theta, action=action, fitted=fitted)
    visible = [e for e in machine.library if e.name not in machine.equivalent("none")]
    effects: tuple[Effect, ...] = ()
    if kind in ("E", "R", "CE"):
        effects = (one(visible),)
    elif kind == "P":
        effects = tuple(machine.effect(one(n)) for n in (machine.fast, machine.slow))
    discrepancy, strength, size = None, 0.0, 0.0
    if kind not in ("C", "CE"):
        size = _log_between(*SIZES)
        discrepancy = draw_discrepancy(machine, action, is_judged=is_judged)
        largest = FARTHEST if discrepancy.kind == "wandering" else torch.inf
        readings = partial(setup.readings, discrepancy=discrepancy)
        strength = setup.sized(size, readings, largest=largest)
        if strength is None:
            return None
    strengths, sizes = [], []
    for effect in effects:
        sizes.append((size or 1.0) * _log_between(*RATIO))
        strengths.append(_sized_effect(setup, sizes[-1], effect))
        if strengths[-1] is None:
            return None
    shape = machine.fn(theta, action[:1]).shape[1:]
    truth = Truth(
        **vars(setup),
        kind=kind,
        effects=effects,
        strengths=tuple(strengths),
        sizes=tuple(sizes),
        discrepancy=discrepancy,
        strength=strength,
        size=size,
        error=machine.noise_sd * torch.randn(num, *shape, dtype=torch.float64),
    )
    every = torch.arange(num)
    moved = truth.clean(every) - truth.respond(every)
    calm = moved.isfinite().all() and moved.abs().max() < MOST * machine.noise_sd
    return truth if bool(calm) or machine.name == "A" else None


def _sized_effect(setup: Setup, size: float, effect: Effect) -> Tensor | None:
    readings = partial(setup.readings, effects=(effect,))
    prior = getattr(effect.prior, "base_dist", effect.prior)
    if isinstance(prior, Uniform):  # it has no null to grow from
        drawn = effect.sample(NUM_DRAWS)
        off = (setup.left(readings(drawn)) / size).log().abs()
        best = int(off.argmin())
        return drawn[best][None] if float(off[best]) < np.log(1.5) else None
    unit = scale_of(effect)
    direction = torch.randn(len(unit), dtype=torch.float64)
    direction = direction / direction.abs().max()
    if is_positive(effect):
        direction = direction.abs()
    direction = unit * direction
    strength = setup.sized(
        size, lambda s: readings(s[:, None] * direction), largest=LARGEST
    )
    return None if strength is None else strength * direction[None]


def _log_between(low: float, high: float) -> float:
    return float(np.exp(np.log(low) + np.log(high / low) * float(torch.rand(()))))
