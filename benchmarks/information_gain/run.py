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
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from benchmarks.rows import frame, write
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


def worlds() -> list[tuple[str, Task, Distribution, Tensor]]:
    """Return name, task, belief and exact gain of every case."""
    cases: list[tuple[str, Task, Distribution, Tensor]] = []
    for variant in ("linear", "sinh", "square"):
        task, before, after = rounds(variant)
        beliefs = task.prior, ExactBelief(after, task.prior)
        for number, exact in enumerate((before, after)):
            gain = exact.expected_information_gain(task.actions.values)
            name = f"{variant}, round {number + 1}"
            cases.append((name, task, beliefs[number], gain))
    task = get_task("oscillator")
    prior = task.reference(torch.empty(0, 2), torch.empty(0, 6))
    assert prior is not None
    gain = torch.as_tensor(prior.expected_information_gain(task.actions.values)[0])
    cases.append(("oscillator, round 1", task, task.prior, gain))
    return cases


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


def main(*, seeds: int = 20, oscillator_seeds: int = 4) -> None:
    """Run what is asked for and is not there yet, and print the table.

    Args:
        seeds: Number of seeds (numerical task).
        oscillator_seeds: Number of seeds of the oscillator.
    """
    rows: list[dict[str, object]] = []
    for name, task, belief, exact in worlds():
        heavy = task.name == "oscillator"
        num_seeds = oscillator_seeds if heavy else seeds
        designer = InformationGainDesigner(task.actions)
        simulators = {
            "noise declared": task.simulator,
            "plain function": lambda t, a, s=task.simulator: s(t, a),
        }
        for kind, simulator in simulators.items():
            result = measure(
                lambda seed, d=designer, s=simulator, b=belief: d.select(
                    None, s, belief=b, seed=seed
                ),
                exact,
                num_seeds,
            )
            rows.append({"case": name, "simulator": kind} | result)
        bound = InformationGainDesigner(
            task.actions, estimator="posterior", eliminate=False
        )
        for kind, settings in NETWORKS.items():
            model = train(task, belief, settings, 0)
            result = measure(
                lambda seed, d=bound, m=model, t=task, b=belief: d.select(
                    m, t.simulator, belief=b, seed=seed
                ),
                exact,
                min(num_seeds, 4),
            )
            rows.append({"case": name, "simulator": f"{kind} network"} | result)
        print(f"{name}: done")
    write(Path(__file__).parent / "result.csv", rows)
    print(frame(rows).to_string(index=False))
