"""Are refined beliefs flagged that have a known error, and right ones not?

    python -m benchmarks calibration.beliefs --problem square

Beliefs are right, twice as wide, half as wide, or without one of two modes; "always"
where every inference has the error, and ranks alone can tell. Seeds from 2000 on judge.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from sbi.utils.sbiutils import within_support
from torch import Tensor
from torch.distributions import Distribution

from benchmarks.calibration.networks import shares
from benchmarks.rows import benchmark
from sbi_active.diagnostics import check_belief
from sbi_active.inference.beliefs.belief import Belief
from sbi_active.inference.emulation.refining import refine
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import simulate
from sbi_active.tasks import get_task

PROBLEMS: dict[str, dict[str, Any]] = {"numerical": {}, "square": {"variant": "square"}}
KINDS = (
    *("right", "right, refits", "wide", "narrow", "lost mode"),
    *("always wide", "always narrow", "always one mode"),
)
NUM_TRIALS = 3
NUM_BANK = 4_000  # draws behind a damaged belief


class Scaled(Belief):
    """A belief stretched about its mean, restricted to the support."""

    def __init__(self, belief: Belief, factor: float) -> None:
        super().__init__(belief.prior)
        self.belief, self.factor = belief, factor
        bank = belief.sample(torch.Size([NUM_BANK]))
        self.center = bank.mean(0)
        bank = self.center + factor * (bank - self.center)
        self.bank = bank[within_support(self.prior, bank)]

    def _sample(self, num_samples: int) -> Tensor:
        return self.bank[torch.randint(len(self.bank), (num_samples,))]

    def _log_prob(self, theta: Tensor) -> Tensor:
        back = self.center + (theta - self.center) / self.factor
        value = self.belief.smooth_log_prob(back)
        return value - len(self.center) * math.log(self.factor)


class OneMode(Belief):
    """A belief of one sign of the first parameter."""

    def __init__(self, belief: Belief, sign: float) -> None:
        super().__init__(belief.prior)
        self.belief, self.sign = belief, sign
        bank = belief.sample(torch.Size([NUM_BANK]))
        self.bank = bank[bank[:, 0] * sign > 0]

    def _sample(self, num_samples: int) -> Tensor:
        return self.bank[torch.randint(len(self.bank), (num_samples,))]

    def _log_prob(self, theta: Tensor) -> Tensor:
        value = self.belief.smooth_log_prob(theta) + math.log(2)
        return torch.where(theta[:, 0] * self.sign > 0, value, -torch.inf)


def belief_row(problem: str, kind: str, seed: int) -> dict[str, object]:
    """Return the row of one belief; "lost mode" needs two, of "square"."""
    begin = time.process_time()
    task = get_task("numerical", **PROBLEMS[problem])
    with forked_generators(derive_seed(seed, "truth")):
        theta = task.prior.sample(torch.Size([1]))
        index = torch.randperm(len(task.actions))[:NUM_TRIALS]
    action = task.actions.values[index]
    x = simulate(
        task.simulator,
        theta.expand(NUM_TRIALS, -1),
        action,
        seed=derive_seed(seed, "trials"),
    ).x

    def right(action: Tensor, x: Tensor, seed: int) -> Any:
        return refine(task.simulator, task.prior, action, x, seed=seed)

    def damaged(belief: Any, seed: int) -> Distribution:
        if kind.endswith("wide"):
            return Scaled(belief, 2.0)
        if kind.endswith("narrow"):
            return Scaled(belief, 0.5)
        if kind.endswith("mode"):
            return OneMode(belief, 1.0 if seed % 2 else -1.0)
        return belief

    def infer(action: Tensor, x: Tensor, seed: int) -> Distribution:
        found = right(action, x, seed)
        return damaged(found, seed) if kind.startswith("always") else found

    own = derive_seed(seed, "belief")
    belief = damaged(right(action, x, own), own)
    trials = [SimpleNamespace(action=a, x=b) for a, b in zip(action, x, strict=True)]
    inference = SimpleNamespace(trials=trials, belief=belief, _prior=task.prior)
    alone = kind.startswith("always")
    found = check_belief(
        inference,
        task.simulator,
        infer=infer,
        num_refits=0 if alone else 2,
        num_repeats=40 if alone or kind == "right" else 0,
        seed=derive_seed(seed, "check"),
    )
    return {
        "verdict": found.verdict,
        "cpu_seconds": time.process_time() - begin,
        "reason": found.reasons[0] if found.reasons else "",
    }


main = benchmark(
    Path(__file__).parent / "results/beliefs.csv",
    belief_row,
    shares,
    skip=lambda problem, kind, seed: kind.endswith("mode") and problem != "square",
    problem=PROBLEMS,
    kind=KINDS,
    seed=range(2_000, 2_040),
)
