"""Numbers in the wrong unit: named, corrected, and as if they had never been told.

    python -m benchmarks robustness.units

A thrown body with three parameters, ten samples of its height a trial, five trials a
campaign on disk. One trial is told in cm or in mm in place of m: trial 1, 3 or 5, ten
campaigns each, whose truths are drawn from the prior. It is *named* where the belief's
warnings say its number right after it was told; it is *corrected* by
``correct(trial, x, reason=)``; and the beliefs of a campaign that never had it are
compared with ``torch.equal`` on 1,000 draws. Writes results/units.json.
"""

from __future__ import annotations

import json
import tempfile
import time
import warnings
from datetime import date
from pathlib import Path
from typing import Any

import torch
from sbi.utils import BoxUniform
from torch import Tensor

from sbi_active import (
    BoxActions,
    Campaign,
    CampaignOptions,
    GaussianNoise,
    MixtureDensity,
    RefinementOptions,
    SimulatorModel,
)
from sbi_active.campaign.options import CampaignDetails
from sbi_active.seeding import derive_seed, forked_generators

RESULT = Path(__file__).parent / "results" / "units.json"
NUM_TRIALS, NUM_CAMPAIGNS = 5, 10
PLACES = (0, 2, 4)
TIMES = torch.linspace(0.1, 1.0, 10)  # s
FACTORS = (100.0, 1_000.0)  # cm or mm for m


def height(theta: Tensor, action: Tensor) -> Tensor:
    """Return the height of a body thrown upwards, m, shape (n, 10).

    Parameters are the release height [m], the share of the commanded speed [1] and a
    linear drag [1/s]; the action is the commanded speed [m/s].
    """
    start, share, drag = theta.split(1, 1)
    fall = 9.81 / drag
    rise = (share * action + fall) * (1 - torch.exp(-drag * TIMES)) / drag
    return start + rise - fall * TIMES


MODEL = SimulatorModel(
    height, noise=GaussianNoise(0.03), parameter_names=["start", "share", "drag"]
)
PRIOR = BoxUniform(torch.tensor([0.2, 0.7, 0.1]), torch.tensor([1.0, 1.2, 1.0]))
ACTIONS = BoxActions([3.0], [9.0], names=["speed"], units=["m/s"])
OPTIONS = CampaignOptions(
    num_simulations=500,
    num_samples=200,
    details=CampaignDetails(num_scored=500),
    density_estimator=MixtureDensity(num_iterations=100),
    refinement=RefinementOptions(num_histories=1_000),
)


def real(theta: Tensor, action: Tensor, seed: int, index: int) -> Tensor:
    """Return what a trial measures."""
    with forked_generators(seed, "real", index):
        return MODEL(theta, action[None])[0]


def begin(folder: str | None, seed: int) -> Campaign:
    """Return a new campaign."""
    return Campaign(
        *(MODEL, PRIOR, ACTIONS), seed=seed, options=OPTIONS, directory=folder
    )


def draws(campaign: Campaign) -> Tensor:
    """Return draws of the belief."""
    with forked_generators(0):
        return campaign.belief.sample(torch.Size([1_000]))


def campaign_with(place: int, factor: float, seed: int) -> dict[str, Any]:
    """Run a campaign with one slip, correct it, and run one without."""
    with forked_generators(seed, "theta"):
        theta = PRIOR.sample(torch.Size([1]))
    start = time.process_time()
    named, suspects = False, set()
    with tempfile.TemporaryDirectory() as folder:
        campaign = begin(f"{folder}/campaign", seed)
        for index in range(NUM_TRIALS):
            action = campaign.ask().action
            x = real(theta, action, seed, index)
            campaign.tell(factor * x if index == place else x)
            campaign.update()
            told = " ".join(campaign.belief.diagnostics.warnings)  # pyright: ignore
            others = {k for k in range(index + 1) if f"trial {k} " in told} - {place}
            suspects |= others
            if index != place:
                continue
            named = f"trial {place} " in told
            campaign.correct(place, x, reason="told in another unit")
        campaign.update()
        campaign.close()
        again = Campaign.load(f"{folder}/campaign", simulator=MODEL)
        after = draws(again)
        health = again.health
    clean = begin(None, seed)
    for trial in again.history:
        clean.attach(trial.action, trial.x)
    clean.update()
    return {
        "place": place + 1,
        "factor": factor,
        "seed": seed,
        "named": named,
        "others named": len(suspects),
        "equal": bool(torch.equal(after, draws(clean))),
        "health": health,
        "cpu_s": round(time.process_time() - start, 1),
    }


def main(
    *,
    campaigns: int = NUM_CAMPAIGNS,
    results: Path = RESULT,
) -> None:
    """Run all campaigns and print what was named, corrected and equal.

    Args:
        campaigns: Number of campaigns a cell.
        results: Folder of the results.
    """
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    rows = []
    for k in range(campaigns):
        for place in PLACES:
            factor = FACTORS[k % len(FACTORS)]
            rows.append(campaign_with(place, factor, derive_seed(k, "units", place)))
            print(rows[-1], flush=True)
    n = len(rows)
    summary = {
        "date": str(date.today()),
        "campaigns": n,
        "named": sum(row["named"] for row in rows),
        "equal to one that never had it": sum(row["equal"] for row in rows),
        "with others named": sum(row["others named"] > 0 for row in rows),
        "healthy at the end": sum(row["health"] == "ok" for row in rows),
    }
    results.write_text(json.dumps({**summary, "rows": rows}, indent=1) + "\n")
    print(summary)
