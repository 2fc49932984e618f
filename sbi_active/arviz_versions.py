"""ArviZ before and after its version 1.0. The only module that imports it."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr

with warnings.catch_warnings():  # ArviZ 0.23 announces 1.0 at every import
    warnings.simplefilter("ignore", FutureWarning)
    import arviz as az


@dataclass
class Groups:
    """Draws and data by group, before they take a library's form.

    Attributes:
        num_chains: Number of chains over which independent draws are split.
        coords: Labels by dimension.
        attrs: Attributes of the whole.
        variables: Array, dimensions and attributes by group and name.
    """

    num_chains: int
    coords: dict[str, Any] = field(default_factory=dict)
    attrs: dict[str, Any] = field(default_factory=dict)
    variables: dict[tuple[str, str], tuple[Any, list[str], dict[str, str]]] = field(
        default_factory=dict
    )

    def add(self, group: str, name: str, draws: Any, dims: list[str]) -> None:
        """Add draws (n, ...), as (chain, draw, ...); those left over are dropped."""
        values = np.array(draws, dtype=float)
        size = len(values) // self.num_chains
        values = values[: size * self.num_chains]
        values = values.reshape(self.num_chains, size, *values.shape[1:])
        self.variables[group, name] = values, ["chain", "draw", *dims], {}

    def add_data(
        self,
        group: str,
        name: str,
        values: Any,
        dims: list[str],
        attrs: dict[str, str] | None = None,
    ) -> None:
        """Add what has no draws."""
        self.variables[group, name] = np.array(values, dtype=float), dims, attrs or {}

    def datasets(self) -> dict[str, xr.Dataset]:
        """Return one dataset a group."""
        found: dict[str, dict[str, xr.DataArray]] = {}
        for (group, name), (values, dims, attrs) in self.variables.items():
            coords = {
                d: self.coords.get(d, np.arange(n))
                for d, n in zip(dims, values.shape, strict=True)
            }
            array = xr.DataArray(values, coords, dims, attrs=attrs)
            found.setdefault(group, {})[name] = array
        attrs = {"inference_library": "sbi-active", **self.attrs}
        return {group: xr.Dataset(v, attrs=attrs) for group, v in found.items()}


def data_tree(groups: Groups) -> xr.DataTree:
    """Return a DataTree, which ArviZ 1.x takes."""
    datasets: Any = {f"/{name}": d for name, d in groups.datasets().items()}
    tree = xr.DataTree.from_dict(datasets)
    tree.attrs.update(groups.attrs)
    return tree


def inference_data(tree: xr.DataTree) -> Any:
    """Return InferenceData, or from ArviZ 1.0 on the tree itself."""
    if int(az.__version__.split(".")[0]) >= 1:
        return tree
    groups: dict[str, Any] = {k: v.to_dataset() for k, v in tree.children.items()}
    return az.InferenceData(**groups)
