"""ArviZ before and after its version 1.0. The only module that imports it."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

with warnings.catch_warnings():  # ArviZ 0.23 announces 1.0 at every import
    warnings.simplefilter("ignore", FutureWarning)
    import arviz as az


def inference_data(
    groups: dict[str, dict[str, np.ndarray]],
    coords: dict[str, Any],
    dims: dict[str, list[str]],
) -> Any:
    """Return InferenceData, or from 1.0 on a DataTree, of one chain.

    Args:
        groups: Variables by group, each of shape (1, draws, ...).
        coords: Labels by dimension.
        dims: Dimensions by variable, after chain and draw.
    """
    if int(az.__version__.split(".")[0]) >= 1:
        return az.from_dict(groups, coords=coords, dims=dims)  # type: ignore[arg-type]
    # ArviZ 0.x takes one log-likelihood value a trial under the name of its variable,
    # whose other dimensions do not exist there: dimensions are given group by group.
    data = az.InferenceData()
    for name, variables in groups.items():
        own = {key: value for key, value in dims.items() if key in variables}
        if name == "log_likelihood":
            own["x"] = ["round"]
        data.extend(az.from_dict(**{name: variables}, coords=coords, dims=own))  # pyright: ignore
    return data


def pareto_smoothed(
    log_likelihood: np.ndarray, *, relative_efficiency: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return smoothed log weights of leaving out each trial, and Pareto shapes k.

    Args:
        log_likelihood: Of each trial given each posterior draw, shape (n, t).
        relative_efficiency: Effective number of draws over their number.

    Returns:
        Log weights, which sum to one over the draws, shape (n, t), and k, shape (t,).

    References:
        Vehtari, Simpson, Gelman, Yao & Gabry, JMLR 25 (2024) 72.
    """
    rows = np.ascontiguousarray(log_likelihood.T, dtype=float)
    if int(az.__version__.split(".")[0]) >= 1:
        from arviz_stats.base import array_stats  # pyright: ignore

        smoothed, k = array_stats.psislw(rows, r_eff=relative_efficiency)
    else:
        smoothed, k = az.psislw(-rows, reff=relative_efficiency)
    smoothed, k = np.asarray(smoothed), np.asarray(k)
    smoothed = smoothed - smoothed.max(1, keepdims=True)
    return (smoothed - np.log(np.exp(smoothed).sum(1, keepdims=True))).T, k
