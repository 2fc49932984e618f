"""Export to ArviZ. The only module that imports it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import simulate

with warnings.catch_warnings():  # ArviZ 0.23 announces 1.0 at every import
    warnings.simplefilter("ignore", FutureWarning)
    import arviz as az

if TYPE_CHECKING:
    from sbi_active.campaign import Campaign

__all__ = ["pareto_smoothed", "to_inference_data"]


def to_inference_data(
    source: Distribution | Campaign,
    *,
    parameter_names: Sequence[str] | None = None,
    num_samples: int = 2_000,
    seed: int = 0,
) -> Any:
    """Return draws and data in ArviZ's format.

    Groups of a belief: posterior, and prior where the belief knows it. A campaign adds
    posterior_predictive and observed_data (one outcome a trial), constant_data (the
    actions), log_likelihood (where the simulator's noise has a density) and
    sample_stats (the belief's log density at each draw). Coordinates name parameters,
    rounds and entries of the action.

    Args:
        source: A belief or a campaign.
        parameter_names: One a parameter; None takes the simulator's, else theta_1, ...
        num_samples: Draws.
        seed: Of the draws.

    Returns:
        ArviZ 0.x: ``InferenceData``; 1.x: ``DataTree``.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> data = to_inference_data(BoxUniform(torch.zeros(2), torch.ones(2)))
        >>> data["posterior"]["theta"].dims
        ('chain', 'draw', 'parameter')
    """
    campaign = None if isinstance(source, Distribution) else source
    belief = source if isinstance(source, Distribution) else source.belief
    prior = getattr(belief, "prior", None) if campaign is None else campaign.prior
    with forked_generators(seed, "posterior"):
        theta = belief.sample((num_samples,))
    if parameter_names is None and campaign is not None:
        parameter_names = getattr(campaign.simulator, "parameter_names", None)
    if parameter_names is None:
        parameter_names = [f"theta_{i + 1}" for i in range(theta.shape[1])]
    if len(parameter_names) != theta.shape[1]:
        raise ValueError(
            f"expected {theta.shape[1]} parameter names; got {[*parameter_names]}; do "
            "give one a parameter"
        )
    groups: dict[str, dict[str, np.ndarray]] = {"posterior": {"theta": _draws(theta)}}
    coords: dict[str, Any] = {"parameter": [*parameter_names]}
    dims = {"theta": ["parameter"]}
    groups["sample_stats"] = {"lp": _draws(belief.log_prob(theta))}
    if prior is not None:
        with forked_generators(seed, "prior"):
            groups["prior"] = {"theta": _draws(prior.sample((num_samples,)))}
    if campaign is not None:
        _add_trials(campaign, theta, groups, coords, dims, seed)
    return _assemble(groups, coords, dims)


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


def _add_trials(
    campaign: Campaign,
    theta: Tensor,
    groups: dict[str, dict[str, np.ndarray]],
    coords: dict[str, Any],
    dims: dict[str, list[str]],
    seed: int,
) -> None:
    trials = [t for t in campaign.history if t.is_measured]
    if not trials:
        return
    action = torch.stack([t.action for t in trials])
    x = torch.stack([t.x for t in trials if t.x is not None])
    x_dims = [f"x_dim_{i}" for i in range(x.ndim - 1)]
    names = getattr(campaign.simulator, "channel_names", None)
    if names is not None and x.ndim > 1 and len(names) == x.shape[-1]:
        x_dims[-1] = "channel"
        coords["channel"] = names
    # The same draws of the posterior stand behind predictive and likelihood.
    pairs = theta.repeat_interleave(len(trials), 0), action.repeat(len(theta), 1)
    rows = simulate(campaign.simulator, *pairs, seed=derive_seed(seed, "predictive"))
    shape = (len(theta), len(trials))
    groups["posterior_predictive"] = {"x": _draws(rows.x.reshape(*shape, *x.shape[1:]))}
    groups["observed_data"] = {"x": x.numpy()}
    groups["constant_data"] = {"action": action.numpy()}
    log_prob = _log_likelihood(campaign.simulator)
    if log_prob is not None:
        observed = x.repeat(len(theta), *[1] * (x.ndim - 1))
        values = log_prob(observed, *pairs).reshape(shape)
        groups["log_likelihood"] = {"x": _draws(values)}
    coords["round"] = [t.index + 1 for t in trials]
    coords["action_entry"] = campaign.actions.names
    dims["x"] = ["round", *x_dims]
    dims["action"] = ["round", "action_entry"]


def _log_likelihood(
    simulator: Any,
) -> Callable[[Tensor, Tensor, Tensor], Tensor] | None:
    """Return log p(x | theta, action) where the noise model makes it known."""
    noise = getattr(simulator, "noise", None)
    if noise is None:
        return None
    return lambda x, theta, action: noise.log_prob(x, simulator.mean(theta, action))


def _draws(values: Tensor) -> np.ndarray:
    """Return draws as one chain, shape (1, n, ...)."""
    return values.detach().numpy()[None]


def _assemble(
    groups: dict[str, dict[str, np.ndarray]],
    coords: dict[str, Any],
    dims: dict[str, list[str]],
) -> Any:
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
