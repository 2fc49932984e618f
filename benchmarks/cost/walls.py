"""How a round grows: parameters, numbers of an outcome, listed actions.

    python -m benchmarks cost.walls

Two rounds of a campaign with the defaults of this library, each size in a process of
its own on one thread; the second is the one that counts, with a belief to begin with.
The simulators cost next to nothing, so that what is measured is the library. A line
that has no figure ran out of the seconds that it was given. Resumable; writes
walls.json beside this file, which ``python -m benchmarks table`` prints.
"""

from __future__ import annotations

import contextlib
import json
import resource
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import torch
from sbi.utils import BoxUniform
from torch import Tensor

from benchmarks.rows import keep, stages
from sbi_active import (
    BoxActions,
    Campaign,
    DiscreteActions,
    GaussianNoise,
    SimulatorModel,
)
from sbi_active.seeding import forked_generators

RESULT = Path(__file__).with_suffix(".json")
SIZES = {
    "parameters": (3, 10, 20, 40, 60),
    "numbers": (10, 100, 1_000, 10_000),
    "actions": (10, 200, 1_000),
}
SECONDS = 600  # of a process


def parameters(num: int) -> tuple[Callable[..., Tensor], int, Any]:
    """Return a simulator of many parameters, their number and the actions."""

    def sums(theta: Tensor, action: Tensor) -> Tensor:
        return torch.cumsum(theta, 1)[:, ::2] * action + theta[:, ::2]

    return sums, num, BoxActions([0.5], [2.0])


def numbers(num: int) -> tuple[Callable[..., Tensor], int, Any]:
    """Return a simulator of long outcomes, of three parameters."""
    times = torch.linspace(0, 5, num)

    def decay(theta: Tensor, action: Tensor) -> Tensor:
        swing = theta[:, 1:2] * torch.sin(times * (1 + theta[:, 2:3]))
        return torch.exp(-(0.2 + theta[:, :1]) * times) * action + swing

    return decay, 3, BoxActions([0.5], [2.0])


def actions(num: int) -> tuple[Callable[..., Tensor], int, Any]:
    """Return a simulator of three parameters and a list of actions."""

    def bent(theta: Tensor, action: Tensor) -> Tensor:
        square, swing = action.sum(1, keepdim=True) ** 2, torch.sin(3 * action[:, -1:])
        line = theta[:, :1] * action[:, :1] + theta[:, 1:2] * square
        return line + swing * theta[:, 2:]

    with forked_generators(0, "listed"):
        return bent, 3, DiscreteActions(torch.rand(num, 3))


KINDS = {"parameters": parameters, "numbers": numbers, "actions": actions}


def measure(kind: str, num: int) -> dict[str, float]:
    """Return CPU seconds of the second round and the memory of two, in this process."""
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    function, dim, space = KINDS[kind](num)
    prior = BoxUniform(torch.zeros(dim), torch.ones(dim))
    model = SimulatorModel(function, noise=GaussianNoise(0.1))
    with forked_generators(1, "truth"):
        truth = prior.sample((1,))
    campaign = Campaign(model, prior, space, seed=0)
    spent: list[float] = []
    for index in range(2):
        start = time.process_time()
        trial = campaign.ask()
        spent.append(time.process_time() - start)
        with forked_generators(2, "real", index):
            x = model(truth, trial.action[None])[0]
        start = time.process_time()
        campaign.tell(x)
        campaign.update()
        spent.append(time.process_time() - start)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return {"ask_s": spent[2], "update_s": spent[3], "peak_gb": peak}


def main() -> None:
    """Run what is not there yet, and write it down."""
    found: dict[str, Any] = {"rounds": {}} | stages(RESULT)
    found["date"] = str(date.today())
    for name, kind, num in [(f"{n:,} {k}", k, n) for k in SIZES for n in SIZES[k]]:
        if name in found["rounds"]:
            continue
        code = (
            "import json; from benchmarks.cost.walls import measure; "
            f"print(json.dumps(measure({kind!r}, {num})))"
        )
        command, told = [sys.executable, "-c", code], b"{}"
        with contextlib.suppress(subprocess.TimeoutExpired):
            told = subprocess.check_output(command, timeout=SECONDS)
        found["rounds"][name] = json.loads(told)
        print(name, found["rounds"][name])
        keep(RESULT, found)
