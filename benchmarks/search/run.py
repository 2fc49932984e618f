"""Continuous and mixed action spaces: regret and simulations of the searches.

    python -m benchmarks search
    python -m benchmarks search --seeds 40 80   # none was tuned on these

"numerical": the numerical task with any action in [-5, 5], under the prior and under
the exact posterior after one trial at -5, also by a cost that moves the optimum off the
end of the range; beside all of a grid of 101 actions. "mixed": a box
of one or two entries with a category of three or four, the information known and of
three local optima a category, another function each seed:

    x = theta sqrt(exp(2 V(action)) - 1) + noise, theta and noise standard normal,

whose information is V. All by the designer's defaults. Regret is exact, in nats (by
cost: the loss of utility times the cost of the best action). Rows are added to
result.csv beside this file, and those that are there are not run again.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution, MultivariateNormal

from benchmarks.information_gain.run import ExactBelief, rounds
from benchmarks.rows import benchmark, column, grouped
from sbi_active import (
    BoxActions,
    DiscreteActions,
    GaussianNoise,
    InformationGainDesigner,
    MixedActions,
    SimulatorModel,
)
from sbi_active.actions import ActionSpace
from sbi_active.display.table import Table
from sbi_active.seeding import derive_seed

RESULT = Path(__file__).with_name("result.csv")

GRID = DiscreteActions(torch.linspace(-5, 5, 101))
FOUND = 0.05  # nats of regret


@dataclass(frozen=True)
class Case:
    """One design problem with its exact answer."""

    space: ActionSpace
    simulator: Any
    belief: Distribution
    utility: Callable[[Tensor], Tensor]
    best: float
    scale: float = 1.0
    cost: Callable[[Tensor], Tensor] | None = None


def dear(action: Tensor) -> Tensor:
    """Return a cost with its least at -1."""
    return 1 + ((action[:, 0] + 1) / 2) ** 2


exactly = cache(rounds)


def numerical(variant: str, number: int, seed: int, *, is_dear: bool = False) -> Case:
    """Return a round of the numerical task, the same for each seed."""
    task, *both = exactly(variant)
    exact = both[number - 1]
    belief = ExactBelief(exact, task.prior) if number > 1 else task.prior
    gain = exact.expected_information_gain
    own = Case(BoxActions(-5.0, 5.0, names=["xi"]), task.simulator, belief, gain, 0.0)
    fine = torch.linspace(-5, 5, 401)[:, None]
    if not is_dear:
        return replace(own, best=float(gain(fine).max()))
    value = gain(fine) / dear(fine)
    return replace(
        own,
        utility=lambda action: gain(action) / dear(action),
        best=float(value.max()),
        scale=float(dear(fine)[value.argmax()]),
        cost=dear,
    )


def mixed(dim: int, num: int, seed: int) -> Case:
    """Return a function with a known optimum on a box and a category."""
    space = MixedActions(
        BoxActions([0.0] * dim, [1.0] * dim),
        DiscreteActions([float(k) for k in range(num)]),
    )
    gain = Bumps(dim, num, seed)
    model = SimulatorModel(gain.mean, noise=GaussianNoise(1.0))
    prior = MultivariateNormal(torch.zeros(1), torch.eye(1))
    return Case(space, model, prior, gain, gain.best())


class Bumps:
    """A known information gain: three bumps a category, one of them the highest."""

    def __init__(self, dim: int, num: int, seed: int) -> None:
        g = torch.Generator().manual_seed(derive_seed(seed, "bumps", dim))
        self.dim = dim
        self.center = 0.05 + 0.9 * torch.rand(num, 3, dim, generator=g)
        self.width = 0.12 + 0.13 * torch.rand(num, 3, generator=g)
        self.height = 0.8 + 1.2 * torch.rand(num, 3, generator=g)
        self.height[int(torch.randint(num, (), generator=g)), 0] = 2.4

    def __call__(self, action: Tensor) -> Tensor:
        k = action[:, self.dim].long()
        square = (action[:, None, : self.dim] - self.center[k]).square().sum(-1)
        bumps = self.height[k] * torch.exp(-square / (2 * self.width[k] ** 2))
        return 0.1 + bumps.amax(1)

    def mean(self, theta: Tensor, action: Tensor) -> Tensor:
        return theta * torch.expm1(2 * self(action)).sqrt()[:, None]

    def best(self) -> float:
        # bumps do not add up, so that the largest is at a center
        k = torch.arange(len(self.center)).repeat_interleave(3)[:, None]
        return float(self(torch.cat([self.center.flatten(0, 1), k], 1)).max())


CASES = {
    f"numerical {variant}, round {number}": partial(numerical, variant, number)
    for variant in ("linear", "sinh", "square")
    for number in (1, 2)
} | {
    "numerical linear, round 1, by cost": partial(numerical, "linear", 1, is_dear=True),
    "mixed 1-D x 3": partial(mixed, 1, 3),
    "mixed 2-D x 4": partial(mixed, 2, 4),
}


def is_left_out(name: str, search: str, seed: int) -> bool:
    """Return whether a case is not run: only mixed ones are another each seed."""
    is_mixed = name.startswith("mixed")
    return search == "exhaustive" if is_mixed else seed >= 20


def run(name: str, search: str, seed: int) -> dict[str, Any]:
    """Return what a search finds, and what it costs."""
    case = CASES[name](seed)
    designer = InformationGainDesigner(GRID if search == "exhaustive" else case.space)
    start = time.process_time()
    design = designer.select(
        None, case.simulator, belief=case.belief, cost=case.cost, seed=seed
    )
    seconds = time.process_time() - start
    utility = float(case.utility(design.action[None])[0])
    return {
        "regret": round(case.scale * (case.best - utility), 5),
        "error": round(float(design.utility[design.index]) - utility, 4),
        "num_simulations": design.num_simulations,
        "cpu_s": round(seconds, 2),
    }


def table(rows: list[dict[str, Any]]) -> str:
    groups = grouped(rows, "case", "search")
    lines = []
    for (case, search), group in groups.items():
        regret, error, spent, cpu = (
            column(group, key)
            for key in ("regret", "error", "num_simulations", "cpu_s")
        )
        full, share = groups.get((case, "exhaustive")), ""
        if full:
            share = f"{spent.mean() / column(full, 'num_simulations').mean():.1%}"
        lines.append(
            [
                *(case, search, len(group)),
                f"{regret.mean():.3f}",
                f"{regret.max():.3f}",
                f"{(regret <= FOUND).mean():.1%}",
                f"{error.mean():+.3f}",
                f"{spent.mean():.0f}",
                share,
                f"{sum(cpu) / len(cpu):.1f}",
            ]
        )
    header = ["case", "search", "runs", "regret", "largest", "<= .05"]
    header += ["error of report", "simulations", "of the grid's", "CPU s"]
    return Table(header, lines).text()


main = benchmark(
    RESULT,
    run,
    table,
    skip=is_left_out,
    case=CASES,
    search=("exhaustive", "gradient"),
    seed=range(80),
)
