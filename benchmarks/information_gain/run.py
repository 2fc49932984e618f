"""Expected information gain beside the exact value: error, regret and CPU time.

    python -m benchmarks information_gain

Rounds 1 and 2 of the numerical task (round 2 from the exact posterior after one trial
at xi = -5), and round 1 of the oscillator (against nested Monte Carlo with the known
likelihood), each by the estimator that "auto" chooses: with the noise declared, and
with the simulator as a plain function. The paper's bound follows, by the faithful and
by the default network, trained on 5,000 rows. Writes result.csv beside this file.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from benchmarks.rows import benchmark, frame
from sbi_active import ASBI, InformationGainDesigner, MixtureDensity, simulate
from sbi_active.inference import Belief
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.tasks import Task, get_task

NETWORKS = {"faithful": MixtureDensity.faithful(), "default": MixtureDensity()}


class ExactBelief(Belief):
    """A reference posterior as a belief."""

    def __init__(self, reference: Any, prior: Distribution) -> None:
        super().__init__(prior)
        self.reference = reference

    def _sample(self, num_samples: int) -> Tensor:
        return self.reference.sample(num_samples, seed=int(torch.randint(2**31, ())))

    def _log_prob(self, theta: Tensor) -> Tensor:
        return self.reference.log_prob(theta.double())


def rounds(variant: str) -> tuple[Any, Any, Any]:
    """Return the numerical task, and exact inference before and after a trial at -5."""
    task = get_task("numerical", variant=variant)
    action = torch.tensor([[-5.0]])
    after = task.reference(action, task.real_system(action[0], seed=0)[None])
    return task, task.reference(torch.empty(0, 1), torch.empty(0, 1)), after


@cache
def world(case: str) -> tuple[Task, Distribution, Tensor]:
    """Return the task of a case, its belief and the exact gain of each action."""
    name, _, number = case.partition(", round ")
    if name == "oscillator":
        task = get_task(name)
        prior = task.reference(torch.empty(0, 2), torch.empty(0, 6))
        assert prior is not None
        gain = torch.as_tensor(prior.expected_information_gain(task.actions.values)[0])
        return task, task.prior, gain
    task, *both = rounds(name)
    exact = both[int(number) - 1]
    belief = task.prior if number == "1" else ExactBelief(exact, task.prior)
    return task, belief, exact.expected_information_gain(task.actions.values)


def train(task: Task, belief: Distribution, settings: MixtureDensity, seed: int) -> Any:
    """Return a posterior trained on 5,000 rows of the belief."""
    with forked_generators(seed, "train"):
        theta = belief.sample(torch.Size([5_000]))
        action = task.actions.sample((5_000,))
        x = simulate(task.simulator, theta, action, seed=derive_seed(seed, "rows")).x
        inference = ASBI(task.prior, settings, show_progress_bars=False)
        inference.append_simulations(theta, x, action=action, belief=belief).train()
    return inference.build_posterior()


def measure(
    select: Callable[[int], Any], exact: Tensor, num_seeds: int
) -> dict[str, object]:
    """Return errors, regret and cost over seeds."""
    errors, regrets, seconds, spent, used = [], [], [], [], ""
    for seed in range(num_seeds):
        start = time.process_time()
        design = select(seed)
        seconds.append(time.process_time() - start)
        errors.append(float((design.expected_information_gain - exact).abs().max()))
        regrets.append(float(exact.max() - exact[design.index]))
        spent.append(design.num_simulations)
        used = design.estimator
    count = len(errors)
    return {
        "estimator": used,
        "max_error": sum(errors) / count,
        "worst_error": max(errors),
        "regret": sum(regrets) / count,
        "worst_regret": max(regrets),
        "cpu_s": sum(seconds) / count,
        "simulations": sum(spent) / count,
        "seeds": count,
    }


def row_of(case: str, kind: str) -> dict[str, object]:
    """Return errors, regret and cost of a case with a simulator or a network."""
    task, belief, exact = world(case)
    num_seeds = 4 if task.name == "oscillator" else 20
    designer, model = InformationGainDesigner(task.actions), None
    simulator: Any = task.simulator
    if kind == "plain function":
        simulator = lambda theta, action: task.simulator(theta, action)  # noqa: E731
    elif kind.endswith(" network"):
        settings = NETWORKS[kind.removesuffix(" network")]
        model, num_seeds = train(task, belief, settings, 0), 4
        designer = InformationGainDesigner(
            task.actions, estimator="posterior", eliminate=False
        )
    return measure(
        lambda seed: designer.select(model, simulator, belief=belief, seed=seed),
        exact,
        num_seeds,
    )


main = benchmark(
    Path(__file__).parent / "result.csv",
    row_of,
    lambda rows: frame(rows).to_string(index=False),
    case=(
        *(
            f"{name}, round {k}"
            for name in ("linear", "sinh", "square")
            for k in (1, 2)
        ),
        "oscillator, round 1",
    ),
    simulator=("noise declared", "plain function", *(f"{n} network" for n in NETWORKS)),
)
