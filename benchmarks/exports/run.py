"""Ten calls of ArviZ on a campaign's export, the same on 0.x and 1.x.

    python -m benchmarks.exports.run

Run it in an environment of each: ArviZ 1.x needs Python 3.12. It prints a line a call
with the warnings raised in it; ArviZ's own dependencies raise some.
"""

from __future__ import annotations

import sys
import tempfile
import warnings
from collections.abc import Callable
from typing import Any

import matplotlib
import torch
import xarray as xr
from sbi.utils import BoxUniform

from sbi_active import (
    BoxActions,
    Campaign,
    CampaignOptions,
    DiscreteActions,
    GaussianNoise,
    MixtureDensity,
    SimulatorModel,
    to_inference_data,
)
from sbi_active.arviz_versions import az
from sbi_active.criticism import Trials, close_loop, generic_effects

IS_NEW = int(az.__version__.split(".")[0]) >= 1


def export_campaign() -> Any:
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
    return to_inference_data(campaign)


def export_rivals() -> dict[str, Any]:
    """Return the exports of two rivals of a report, with and without a bias."""
    model = SimulatorModel(
        lambda theta, action: theta * action,
        noise=GaussianNoise(0.1),
        parameter_names=["gain"],
    )
    action = torch.linspace(0.5, 2.0, 6)[:, None]
    actions = BoxActions([0.5], [2.0], names=["push"], units=["N"])
    library = generic_effects(model, actions)
    report = close_loop(
        model,
        BoxUniform(torch.zeros(1), 2 * torch.ones(1)),
        Trials(action, 0.8 * action + 0.7),
        effects=[e for e in library if "offset" in e.name or "bias" in e.name],
        actions=actions,
        seed=0,
        evaluate=False,
    )
    names = ("none", str(report.tracing.key))
    return {name: to_inference_data(report, model=name) for name in names}


def main() -> None:
    """Print a line a call."""
    matplotlib.use("Agg")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        data, rivals = export_campaign(), export_rivals()
    directory = tempfile.mkdtemp()
    read_nc: Any = xr.open_datatree if IS_NEW else az.from_netcdf
    read_zarr: Any = xr.open_datatree if IS_NEW else az.from_zarr
    ppc: Any = getattr(az, "plot_ppc_dist" if IS_NEW else "plot_ppc")
    theta: dict[str, Any] = {"var_names": ["theta"]}
    calls: dict[str, Callable[[], Any]] = {
        "summary": lambda: az.summary(data),
        "rhat": lambda: az.rhat(data),
        "ess": lambda: az.ess(data),
        "plot_pair": lambda: az.plot_pair(data, **theta),
        "plot_trace": lambda: az.plot_trace(data, **theta),
        "plot_ppc": lambda: ppc(data),
        "loo": lambda: az.loo(data),
        "compare": lambda: az.compare(rivals),
        "netcdf": lambda: (
            data.to_netcdf(f"{directory}/a.nc"),
            read_nc(f"{directory}/a.nc"),
        ),
        "zarr": lambda: (
            data.to_zarr(f"{directory}/a.zarr"),
            read_zarr(f"{directory}/a.zarr"),
        ),
    }
    print(f"Python {sys.version.split()[0]}, ArviZ {az.__version__}")
    for name, call in calls.items():
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                call()
                outcome = "runs"
            except Exception as error:
                outcome = f"{type(error).__name__}: {error}"
        texts = {str(w.message).splitlines()[0][:90] for w in caught}
        print(f"{name:10s} {outcome[:90]}; warnings: {'; '.join(texts) or 'none'}")


if __name__ == "__main__":
    main()
