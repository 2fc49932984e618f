"""Continuous and mixed action spaces: regret and simulations of the searches.

    python -m benchmarks search [--cases numerical mixed]
    python -m benchmarks search --cases mixed --first 40   # none was tuned on these

"numerical": the numerical task with any action in [-5, 5], under the prior and under
the exact posterior after one trial at -5, also by a cost that moves the optimum off the
end of the range; beside the exhaustive search of a grid of 101 actions. "mixed": a box
of one or two entries with a category of three or four, the information known and of
three local optima a category, another function each seed:

    x = theta sqrt(exp(2 V(action)) - 1) + noise, theta and noise standard normal,

whose information is V. All by the designer's defaults. Regret is exact, in nats (by
cost: the loss of utility times the cost of the best action). Rows are added to
result.csv beside this file, and those that are there are not run again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
from torch import Tensor
from torch.distributions import Distribution, MultivariateNormal

from benchmarks.information_gain.run import ExactBelief, rounds
from benchmarks.rows import column, grouped, resumed
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

    name: str
    seed: int
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


def numerical(num_seeds: int) -> Iterator[Case]:
    """Yield the cases of the numerical task."""
    box = BoxActions(-5.0, 5.0, names=["xi"])
    fine = torch.linspace(-5, 5, 401)[:, None]
    for variant in ("linear", "sinh", "square"):
        task, *both = rounds(variant)
        for trials, exact in enumerate(both):
            gain = exact.expected_information_gain
            belief = ExactBelief(exact, task.prior) if trials else task.prior
            name = f"numerical {variant}, round {trials + 1}"
            best = float(gain(fine).max())
            given = (box, task.simulator, belief)
            for seed in range(num_seeds):
                yield Case(name, seed, *given, gain, best)
            if trials or variant != "linear":
                continue

            def by_cost(action: Tensor, gain: Any = gain) -> Tensor:
                return gain(action) / dear(action)

            value = by_cost(fine)
            scale, name = float(dear(fine)[value.argmax()]), f"{name}, by cost"
            for seed in range(num_seeds):
                most = float(value.max())
                yield Case(name, seed, *given, by_cost, most, scale, dear)


def mixed(num_seeds: int) -> Iterator[Case]:
    """Yield functions with known optima on a box and a category."""
    prior = MultivariateNormal(torch.zeros(1), torch.eye(1))
    for dim, num in ((1, 3), (2, 4)):
        space = MixedActions(
            BoxActions([0.0] * dim, [1.0] * dim),
            DiscreteActions([float(k) for k in range(num)]),
        )
        for seed in range(num_seeds):
            gain = Bumps(dim, num, seed)
            model = SimulatorModel(gain.mean, noise=GaussianNoise(1.0))
            name = f"mixed {dim}-D x {num}"
            yield Case(name, seed, space, model, prior, gain, gain.best())


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


CASES = {"numerical": (numerical, 20), "mixed": (mixed, 80)}


def run(case: Case, search: str) -> dict[str, Any]:
    space = GRID if search == "exhaustive" else case.space
    designer = InformationGainDesigner(space, search=search)
    start = time.process_time()
    design = designer.select(
        None, case.simulator, belief=case.belief, cost=case.cost, seed=case.seed
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


def main(
    *,
    cases: Annotated[Sequence[str], CASES] = (*CASES,),
    searches: Sequence[str] = ("exhaustive", "gradient"),
    first: int = 0,
    summary: bool = False,
) -> None:
    """Run what is asked for and is not there yet, and print the table.

    Args:
        cases: Number of cases.
        searches: Names of the searches.
        first: Number of the first case.
        summary: Whether to run nothing, and print the table of the rows.
    """
    every = {
        (case.name, search, case.seed): (case, search)
        for name in cases
        for make, num_seeds in [CASES[name]]
        for case in ([] if summary else make(num_seeds))
        for search in searches
        if case.seed >= first and (name, search) != ("mixed", "exhaustive")
    }
    rows = resumed(
        RESULT, ["case", "search", "seed"], every, lambda *job: run(*every[job])
    )
    print(table([r for r in rows if int(r["seed"]) >= first]))
