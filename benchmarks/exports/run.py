"""Ten calls of ArviZ on a campaign's export, the same on 0.x and 1.x.

    python -m benchmarks exports

    python -m benchmarks exports --write DIR   # for benchmarks/exports/calls.py

Run it in an environment of each: ArviZ 1.x needs Python 3.12. It prints a line a call
with the warnings raised in it; ArviZ's own dependencies raise some. ArviZ 0.23 reads
and writes Zarr of the second generation alone, which needs older company:
``zarr==2.18.7 numcodecs==0.15.1 xarray==2025.1.2``.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import torch
from sbi.utils import BoxUniform

from benchmarks.exports.calls import run
from sbi_active import (
    BoxActions,
    Campaign,
    CampaignOptions,
    DiscreteActions,
    GaussianNoise,
    MixtureDensity,
    SimulatorModel,
    to_datatree,
    to_inference_data,
)
from sbi_active.criticism import Trials, close_loop, generic_effects


def export_campaign(export: Any) -> Any:
    """Return the export of a campaign of four trials."""
    model = SimulatorModel(
        lambda theta, action: theta * action,
        noise=GaussianNoise(0.2),
        parameter_names=["mass", "friction"],
        channel_names=["x", "y"],
    )
    campaign = Campaign(
        model,
        BoxUniform(torch.zeros(2), torch.ones(2)),
        DiscreteActions([1.0, 2.0], names=["push"], units=["N"]),
        method="nsbi",
        options=CampaignOptions(
            num_simulations=300,
            num_samples=40,
            density_estimator=MixtureDensity(hidden_features=(8,), num_iterations=50),
        ),
    )
    for _ in range(4):
        campaign.ask()
        campaign.tell([0.5, 0.4])
    campaign.update()
    return export(campaign)


def export_rivals(export: Any) -> dict[str, Any]:
    """Return the exports of two rivals of a report, with and without a bias."""
    model = SimulatorModel(
        lambda theta, action: theta * action,
        noise=GaussianNoise(0.1),
        parameter_names=["gain"],
    )
    action = torch.linspace(0.5, 2.0, 40)[:, None]
    actions = BoxActions([0.5], [2.0], names=["push"], units=["N"])
    library = generic_effects(model, actions)
    report = close_loop(
        model,
        BoxUniform(torch.zeros(1), 2 * torch.ones(1)),
        Trials(action, 0.8 * action + 0.2),
        effects=[e for e in library if "offset" in e.name or "bias" in e.name],
        actions=actions,
        seed=0,
        evaluate=False,
    )
    names = ("none", str(report.tracing.key))
    return {name: export(report, model=name) for name in names}


def main(*, write: Path | None = None) -> None:
    """Print a line a call, or write the exports.

    Args:
        write: Folder for the exports, which ``calls.py`` reads anywhere.
    """
    export: Any = to_inference_data if write is None else to_datatree
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        data, rivals = export_campaign(export), export_rivals(export)
    if write is None:
        print(run(data, rivals))
        return
    write.mkdir(parents=True, exist_ok=True)
    for name, tree in {"campaign": data, **rivals}.items():
        tree.to_netcdf(write / f"{name}.nc", engine="h5netcdf")
