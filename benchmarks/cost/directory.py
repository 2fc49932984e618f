"""What keeping a campaign on disk costs: a tell, a load.

    python -m benchmarks cost.directory

* a ``tell`` of 100 numbers of a trial that was asked for, in memory and on disk, and
  the ``fsync`` alone of a file of as many bytes, in turn;
* ``Campaign.load`` of a campaign of 200 trials of 100 numbers, and of its belief, which
  was inferred from all of them at once.

Writes directory.json beside this file.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import torch
from sbi.utils import BoxUniform
from torch import Tensor

from benchmarks.rows import recorded
from sbi_active import (
    BoxActions,
    Campaign,
    CampaignOptions,
    GaussianNoise,
    RefinementOptions,
    SimulatorModel,
)
from sbi_active.campaign.telling import Facts
from sbi_active.seeding import forked_generators

RESULT = Path(__file__).with_suffix(".json")
NUMBERS, TRIALS, REPEATS = 100, 200, 200
PRIOR = BoxUniform(torch.zeros(2), torch.ones(2))
ACTIONS = BoxActions([0.5], [2.0])
OPTIONS = CampaignOptions(
    network="on demand",
    refinement=RefinementOptions(num_histories=1_000),
)
THETA = torch.tensor([[0.3, 0.6]])


def line(theta: Tensor, action: Tensor) -> Tensor:
    """Return a straight line of so many numbers."""
    return theta[:, :1] * action + theta[:, 1:] * torch.linspace(0, 1, NUMBERS)


MODEL = SimulatorModel(line, noise=GaussianNoise(0.5))


def trial(index: int) -> tuple[Tensor, Tensor]:
    """Return an action and what it measures."""
    with forked_generators(7, "real", index):
        action = 0.5 + 1.5 * torch.rand(1)
        return action, MODEL(THETA, action[None])[0]


def begin(folder: Path | None) -> Campaign:
    """Return a new campaign."""
    return Campaign(
        *(MODEL, PRIOR, ACTIONS), method="nsbi", options=OPTIONS, directory=folder
    )


def milliseconds(work: Callable[[], Any]) -> float:
    """Return the wall time of a call."""
    start = time.perf_counter()
    work()
    return 1e3 * (time.perf_counter() - start)


def tells(folder: Path) -> dict[str, float]:
    """Return median milliseconds of a tell in memory, on disk, and of an fsync."""
    in_memory, on_disk = begin(None), begin(folder / "tells")
    times: dict[str, list[float]] = {"memory": [], "disk": [], "fsync": []}
    for index in range(REPEATS):
        action, x = trial(index)
        for name, campaign in (("memory", in_memory), ("disk", on_disk)):
            campaign._record("asked", Facts(index, action.tolist()))
            times[name].append(milliseconds(partial(campaign.tell, x)))
        times["fsync"].append(milliseconds(lambda: _synchronized(folder / "bytes")))
    on_disk.close()
    return {name: round(median(values), 2) for name, values in times.items()}


def _synchronized(path: Path) -> None:
    with open(path, "ab") as file:
        file.write(b"x" * 2_400)
        file.flush()
        os.fsync(file.fileno())


def load(folder: Path) -> dict[str, float]:
    """Return seconds of a load, and of the belief, which is read when asked for."""
    with begin(folder / "long") as campaign:
        for index in range(TRIALS):
            campaign.attach(*trial(index))
        # All at once, as after an adoption: one after another would take hours.
        state = campaign.state
        state.versions[-1] = replace(state.version, trials=(*range(TRIALS),))
        state.is_stale = True
        campaign.update()
    start = time.perf_counter()
    campaign = Campaign.load(folder / "long", simulator=MODEL)
    loaded = time.perf_counter() - start
    _ = campaign.belief.mean
    size = sum(p.stat().st_size for p in (folder / "long").rglob("*") if p.is_file())
    return {
        "load_s": round(loaded, 2),
        "load_and_belief_s": round(time.perf_counter() - start, 2),
        "trials": len(campaign.history),
        "megabytes": round(size / 1e6, 1),
    }


def main() -> None:
    """Measure, print and write."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        result = {"tell_ms": tells(folder), "load": load(folder)}
    print(result)
    recorded(RESULT, "cost.directory", **result)
