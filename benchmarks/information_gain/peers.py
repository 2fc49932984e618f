"""Expected information gain beside pyro.contrib.oed, in one run on one core.

The numerical task, 21 actions, round 1 (the prior) and round 2 (the exact posterior
after one trial at xi = -5, as a pool of draws common to all), and round 1 of its
variant "sinh", whose outcomes are not linear in the parameters. For each method: the
largest and root mean square error over the actions against the exact gain, whether it
names the same action, CPU seconds and simulations, medians over seeds. Pyro's guides
have their own parameters for every action, outcomes standardized by a pilot of 1,000
simulations an action, and a learning rate that falls a hundredfold; "started" guides
begin at the least-squares regression of the pilot. Run from the root of the
repository; it writes peers.csv beside this file::

    python -m benchmarks information_gain.peers [--seeds 5]
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import pyro
import pyro.optim
import torch
from pyro.contrib.oed.eig import (
    marginal_eig,
    marginal_likelihood_eig,
    nmc_eig,
    posterior_eig,
)
from torch import Tensor

from benchmarks.information_gain.worlds import (
    NUM_PILOT,
    World,
    conditional,
    marginal,
    posterior,
    worlds,
)
from benchmarks.rows import frame, write
from sbi_active import InformationGainDesigner
from sbi_active.seeding import forked_generators

FINAL = 2_000  # simulations an action of pyro's final estimate


#: What runs: the gains (a,) and the number of simulations.
Method = Callable[[World, int], tuple[Tensor, int]]


def ours(num_samples: int, *, declared: bool) -> Method:
    """Return the default designer, with or without declared noise."""

    def run(world: World, seed: int) -> tuple[Tensor, int]:
        simulator = world.task.simulator
        designer = InformationGainDesigner(world.task.actions, num_samples=num_samples)
        design = designer.select(
            None,
            simulator if declared else lambda theta, action: simulator(theta, action),
            belief=world.belief,
            seed=seed,
        )
        return design.expected_information_gain, design.num_simulations

    return run


def nested(num_outer: int, num_inner: int) -> Method:
    """Return pyro's nested Monte Carlo, which is given the likelihood."""

    def run(world: World, seed: int) -> tuple[Tensor, int]:
        design = world.task.actions.values
        gain = nmc_eig(world.model, design, "x", "theta", N=num_outer, M=num_inner)
        return gain, (num_outer + num_inner) * len(design)

    return run


def variational(
    kind: str, num_steps: int, rate: float, *, batch: int = 100, **options: Any
) -> Method:
    """Return one of pyro's variational estimates.

    Args:
        kind: "posterior", "marginal" or "marginal_likelihood".
        num_steps: Of the optimizer.
        rate: Learning rate of Adam, at first.
        batch: Simulations an action and step.
        options: Of the posterior's or the likelihood's guide.
    """

    def run(world: World, seed: int) -> tuple[Tensor, int]:
        pyro.clear_param_store()
        design, pilot = world.task.actions.values, world.pilot()
        common = (world.model, design, "x", "theta", batch, num_steps)
        falling = 0.01 ** (1 / max(num_steps, 1))
        optim = pyro.optim.ClippedAdam({"lr": rate, "lrd": falling})
        last: dict[str, Any] = {"final_num_samples": FINAL}
        if kind == "posterior":
            guide = posterior(pilot, **options)
            entropy = posterior_eig(*common, guide, optim, eig=False, **last)
            gain = world.entropy - entropy
        elif kind == "marginal":
            gain = marginal_eig(*common, marginal(pilot), optim, **last)
        else:
            guides = marginal(pilot), conditional(pilot, **options)
            gain = marginal_likelihood_eig(*common, *guides, optim, **last)
        num = NUM_PILOT + num_steps * batch + FINAL
        return torch.as_tensor(gain).detach(), num * len(design)

    return run


STARTED = {"started": True}
MIXTURE = {"batch": 50, "started": True, "num_components": 4}
#: Name, what it is given, method.
METHODS: dict[str, tuple[str, Method]] = {
    **{
        f"designer, plain function{words}": ("simulator", ours(num, declared=False))
        for words, num in (
            *(("", 1_500), (", 6,000", 6_000), (", 15,000", 15_000)),
            (", 20,000", 20_000),
        )
    },
    "designer, noise declared": ("noise", ours(1_500, declared=True)),
    **{
        f"posterior_eig, {guide}, {num:,} steps": (
            "simulator",
            variational("posterior", num, rate, **options),
        )
        for guide, num, rate, options in (
            ("Gaussian", 1_000, 0.03, {}),
            ("Gaussian", 3_000, 0.03, {}),
            ("Gaussian started", 0, 0.0, STARTED),
            ("Gaussian started", 1_000, 1e-3, STARTED),
            ("mixture started", 1_000, 5e-3, MIXTURE),
            ("mixture started", 3_000, 5e-3, MIXTURE),
        )
    },
    "marginal_likelihood_eig, linear started, 1,000 steps": (
        "simulator",
        variational("marginal_likelihood", 1_000, 3e-3, **STARTED),
    ),
    "marginal_eig, 1,000 steps": ("likelihood", variational("marginal", 1_000, 0.03)),
    "nmc_eig, M = 10,000": ("likelihood", nested(100, 10_000)),
    "nmc_eig, M = 100,000": ("likelihood", nested(30, 100_000)),
}
#: Methods that run in the first case only.
DEAR = {
    "posterior_eig, Gaussian, 3,000 steps",
    "posterior_eig, mixture started, 3,000 steps",
    "nmc_eig, M = 100,000",
}


def measure(world: World, method: Method, num_seeds: int) -> dict[str, object]:
    """Return medians of errors and costs over seeds."""
    rows = []
    for seed in range(num_seeds):
        start = time.process_time()
        with forked_generators(seed, "peers"):
            gain, num_simulations = method(world, seed)
        seconds = time.process_time() - start
        error = (gain - world.exact).abs()
        right = bool(gain.argmax() == world.exact.argmax())
        rms = float(error.square().mean().sqrt())
        rows.append((float(error.max()), rms, seconds, num_simulations, right))
    largest, rms, seconds, simulations, right = zip(*rows, strict=True)
    return {
        "max_error": median(largest),
        "worst_max_error": max(largest),
        "rms_error": median(rms),
        "same_action": f"{sum(right)} / {num_seeds}",
        "cpu_s": median(seconds),
        "simulations": median(simulations),
    }


def main(
    *,
    seeds: int = 5,
    out: Path = Path(__file__).parent / "peers.csv",
    only: Sequence[str] = (*METHODS,),
) -> None:
    """Run what is asked for and is not there yet, and print the table.

    Args:
        seeds: Number of seeds.
        out: File of the results.
        only: Names, or parts of names, that are run; all by default.
    """
    rows = []
    for i, world in enumerate(worlds()):
        for name, (given, method) in METHODS.items():
            if name not in only or (i > 0 and name in DEAR):
                continue
            result = measure(world, method, seeds)
            rows.append({"case": world.name, "method": name, "given": given} | result)
            print(*rows[-1].values(), sep="  ", flush=True)
    write(out, rows)
    print(frame(rows).to_string(index=False))
