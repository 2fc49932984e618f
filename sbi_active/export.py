"""Export to ArviZ."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution

from sbi_active.arviz_versions import inference_data
from sbi_active.inference.beliefs.belief import names_of
from sbi_active.seeding import derive_seed, forked_generators
from sbi_active.simulation import simulate

if TYPE_CHECKING:
    from sbi_active.campaign import Campaign


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
        parameter_names: One a parameter; None takes the simulator's, which beliefs
            remember, else theta_1, ...
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
        parameter_names = names_of(belief, theta.shape[1])
    if len(parameter_names) != theta.shape[1]:
        raise ValueError(
            f"expected {theta.shape[1]} parameter names; got {[*parameter_names]}; "
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
    return inference_data(groups, coords, dims)


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
    noise = getattr(campaign.simulator, "noise", None)
    if noise is not None:
        observed = x.repeat(len(theta), *[1] * (x.ndim - 1))
        simulator: Any = campaign.simulator
        values = noise.log_prob(observed, simulator.mean(*pairs)).reshape(shape)
        groups["log_likelihood"] = {"x": _draws(values)}
    coords["round"] = [t.index + 1 for t in trials]
    coords["action_entry"] = campaign.actions.names
    dims["x"] = ["round", *x_dims]
    dims["action"] = ["round", "action_entry"]


def _draws(values: Tensor) -> np.ndarray:
    """Return draws as one chain, shape (1, n, ...)."""
    return values.detach().numpy()[None]
