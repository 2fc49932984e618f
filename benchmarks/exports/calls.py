"""Ten calls of ArviZ on exports in files, the same on 0.x and 1.x.

    python -m benchmarks exports --write DIR   # by this library
    python benchmarks/exports/calls.py DIR         # in an environment of each

It needs ArviZ, h5netcdf and Zarr, and not this library. It prints a line a call with
the warnings raised in it.
"""

from __future__ import annotations

import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib
import xarray as xr

with warnings.catch_warnings():  # ArviZ 0.23 announces 1.0 at every import
    warnings.simplefilter("ignore", FutureWarning)
    import arviz as az

IS_NEW = int(az.__version__.split(".")[0]) >= 1
READ_NETCDF: Any = xr.open_datatree if IS_NEW else az.from_netcdf


def calls(data: Any, rivals: dict[str, Any], out: str) -> dict[str, Callable[[], Any]]:
    """Return the calls by name.

    Args:
        data: Export of a campaign.
        rivals: Exports of a report's rivals, by name.
        out: A folder for files.
    """
    read_zarr: Any = xr.open_datatree if IS_NEW else az.from_zarr
    ppc: Any = getattr(az, "plot_ppc_dist" if IS_NEW else "plot_ppc")
    theta: dict[str, Any] = {"var_names": ["theta"]}

    def same(again: Any) -> None:
        was, now = data["posterior"]["theta"], again["posterior"]["theta"]
        if not (was == now).all() or was.dims != now.dims:
            raise ValueError(f"expected {was}; got {now}; it did not come back")

    return {
        "summary": lambda: az.summary(data),
        "rhat": lambda: az.rhat(data),
        "ess": lambda: az.ess(data),
        "plot_pair": lambda: az.plot_pair(data, **theta),
        "plot_trace": lambda: az.plot_trace(data, **theta),
        "plot_ppc": lambda: ppc(data),
        "loo": lambda: az.loo(data),
        "compare": lambda: az.compare(rivals),
        "netcdf": lambda: (
            data.to_netcdf(f"{out}/a.nc"),
            same(READ_NETCDF(f"{out}/a.nc")),
        ),
        "zarr": lambda: (
            data.to_zarr(f"{out}/a.zarr"),
            same(read_zarr(f"{out}/a.zarr")),
        ),
    }


def run(data: Any, rivals: dict[str, Any]) -> str:
    """Return a line a call: whether it runs, and warnings."""
    matplotlib.use("Agg")
    lines = [f"Python {sys.version.split()[0]}, ArviZ {az.__version__}"]
    for name, call in calls(data, rivals, tempfile.mkdtemp()).items():
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                call()
                outcome = "runs"
            except Exception as error:
                outcome = f"{type(error).__name__}: {error}"
        texts = {str(w.message).splitlines()[0][:90] for w in caught}
        said = "; ".join(sorted(texts)) or "none"
        lines.append(f"{name:10s} {outcome[:90]}; warnings: {said}")
    return "\n".join(lines)


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    found = {path.stem: READ_NETCDF(str(path)) for path in folder.glob("*.nc")}
    print(run(found.pop("campaign"), found))
