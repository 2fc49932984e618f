"""What keeping a campaign on disk costs: a tell, a load, a round.

    python -m benchmarks cost.directory

* a ``tell`` of 100 numbers, in memory and on disk, and the ``fsync`` alone of a file of
  as many bytes, in turn;
* ``Campaign.load`` of a campaign of 200 trials of 100 numbers, and of its belief, which
  was inferred from all of them at once;
* CPU seconds of the update by one trial of ten numbers as trials grow from 1 to 100, on
  disk and in memory in turn.

Writes directory.json beside this file.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import date
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import torch
from sbi.utils import BoxUniform
from torch import Tensor

from benchmarks.rows import keep
from sbi_active import (
    BoxActions,
    Campaign,
    CampaignOptions,
    GaussianNoise,
    RefinementOptions,
    SimulatorModel,
)
from sbi_active.campaign.options import CampaignDetails
from sbi_active.seeding import forked_generators

RESULT = Path(__file__).with_suffix(".json")
NUMBERS, TRIALS, AFTER = 100, 200, (12, 25, 50, 100)
FEW = 10  # numbers of a trial, where what each round costs is measured
REPEATS = 30
PRIOR = BoxUniform(torch.zeros(2), torch.ones(2))
ACTIONS = BoxActions([0.5], [2.0])
OPTIONS = CampaignOptions(
    network="on demand",
    details=CampaignDetails(num_scored=500),
    refinement=RefinementOptions(num_histories=1_000),
)
THETA = torch.tensor([[0.3, 0.6]])


def line(num: int) -> SimulatorModel:
    """Return the model of a straight line of so many numbers."""

    def values(theta: Tensor, action: Tensor) -> Tensor:
        return theta[:, :1] * action + theta[:, 1:] * torch.linspace(0, 1, num)

    return SimulatorModel(values, noise=GaussianNoise(0.5))


LONG, SHORT = line(NUMBERS), line(FEW)


def trial(index: int, model: SimulatorModel = LONG) -> tuple[Tensor, Tensor]:
    """Return an action and what it measures."""
    with forked_generators(7, "real", index):
        action = 0.5 + 1.5 * torch.rand(1)
        return action, model(THETA, action[None])[0]


def begin(folder: Path | None, model: SimulatorModel = LONG) -> Campaign:
    """Return a new campaign."""
    return Campaign(
        *(model, PRIOR, ACTIONS), method="nsbi", options=OPTIONS, directory=folder
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
        times["memory"].append(milliseconds(partial(in_memory.attach, action, x)))
        times["disk"].append(milliseconds(partial(on_disk.attach, action, x)))
        times["fsync"].append(milliseconds(lambda: _synchronized(folder / "bytes")))
    on_disk.close()
    return {name: round(median(values), 2) for name, values in times.items()}


def _synchronized(path: Path) -> None:
    with open(path, "ab") as file:
        file.write(b"x" * 2_400)
        file.flush()
        os.fsync(file.fileno())


def rounds(folder: Path) -> list[dict[str, float]]:
    """Return CPU seconds of an update after so many trials, with and without a disk."""
    kept = {"disk": begin(folder / "rounds", SHORT), "memory": begin(None, SHORT)}
    rows = []
    for index in range(max(AFTER)):
        action, x = trial(index, SHORT)
        spent = {}
        for name, campaign in kept.items():
            campaign.attach(action, x)
            start = time.process_time()
            campaign.update()
            spent[name] = round(time.process_time() - start, 3)
        rows.append({"trials": index + 1, **spent})
        if index + 1 in AFTER:
            print(rows[-1], flush=True)
    kept["disk"].close()
    return rows


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
    campaign = Campaign.load(folder / "long", simulator=LONG)
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
        result: dict[str, Any] = {"date": str(date.today()), "tell_ms": tells(folder)}
        print(result["tell_ms"], flush=True)
        result["update_cpu_s"] = rounds(folder)
        result["load"] = load(folder)
        print(result["load"])
    by_count = {row["trials"]: row for row in result["update_cpu_s"]}
    near = {
        count: median(by_count[k]["disk"] for k in range(max(count - 5, 1), count + 1))
        for count in AFTER
    }
    result["update_cpu_s_near"] = near
    print(near)
    keep(RESULT, result)
