"""Pyro models as simulators."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyro
import torch
from pyro import poutine
from pyro.poutine.subsample_messenger import _Subsample
from sbi.utils import MultipleIndependent
from torch import Tensor
from torch.distributions import Distribution, Independent, Normal, StudentT

from sbi_active.seeding import forked_generators
from sbi_active.simulation import GaussianNoise, SimulatorModel, StudentTNoise


@dataclass(frozen=True)
class PyroProblem:
    """Simulator and prior that a Pyro model gives a campaign.

    Attributes:
        simulator: Simulator, with a noise where the outcome has a known likelihood.
        prior: Prior of all latent sites.
        parameter_names: Names of the prior's entries.
    """

    simulator: SimulatorModel
    prior: Distribution
    parameter_names: list[str]


def from_pyro(
    model: Callable[[Tensor], Any],
    action: Tensor,
    *,
    outcome: str = "x",
    num_tried: int = 4,
) -> PyroProblem:
    """Return simulator, prior, noise and names of a Pyro model.

    The model takes one action, shape (action_dim,), and has a sample site for each
    parameter and one for the outcome. An outcome that is normal, or Student t with more
    than two degrees of freedom, of constant scale becomes a noise-free simulator with
    that noise; any other is drawn.

    Args:
        model: ``model(action)``.
        action: Action to try it at, shape (action_dim,).
        outcome: Name of the outcome's site.
        num_tried: Number of prior draws at which the model is looked at.

    Raises:
        ValueError: If there is no such site, no parameter, a discrete one, or one whose
            prior depends on another or on the action.

    Example:
        >>> import pyro.distributions as dist
        >>> def model(action):
        ...     slope = pyro.sample("slope", dist.LogNormal(0.0, 0.5))
        ...     return pyro.sample("x", dist.Normal(slope * action, 0.1).to_event(1))
        >>> problem = from_pyro(model, torch.ones(1))
        >>> problem.parameter_names, problem.simulator.noise
        (['slope'], GaussianNoise(sd=[0.1...]))
    """
    action = torch.as_tensor(action, dtype=torch.float32).reshape(-1)
    with forked_generators(0, "pyro"):
        traces: list[Any] = [
            poutine.trace(model).get_trace(action * scale)
            for scale in torch.linspace(1, 0.5, num_tried)
        ]
    sites = [_latent(trace, outcome) for trace in traces]
    first = sites[0]
    if outcome not in traces[0].nodes or not first:
        raise ValueError(
            f"expected a sample site {outcome!r} and others for the parameters; got "
            f"{[*traces[0].stochastic_nodes]}; name the outcome with outcome=..."
        )
    for name, d in first.items():
        support = _inner(d.support, "base_constraint")
        if support.is_discrete or support.event_dim or len(_shape(d)) > 1:
            raise ValueError(
                "expected vectors of continuous parameters with bounds of their own; "
                f"got {name!r} of shape {tuple(_shape(d))} on {d.support}; sum a "
                "discrete one out in the model, and write others by free ones"
            )
        if any(name not in other or not _same(d, other[name]) for other in sites):
            raise ValueError(
                f"expected priors that depend on nothing; got {name!r}, whose prior "
                "changes from run to run; write it as a location and a scale times a "
                "site of its own"
            )
    sizes = {name: _shape(d).numel() for name, d in first.items()}
    names = [
        name if size == 1 else f"{name}_{i + 1}"
        for name, size in sizes.items()
        for i in range(size)
    ]
    # Each site as a vector, one number as a vector of one.
    vectors = [d if _shape(d) else d.expand((1,)) for d in first.values()]
    parts = [Independent(d, 1) if d.batch_shape else d for d in vectors]
    prior = parts[0]
    if len(parts) > 1:
        prior = MultipleIndependent(parts, validate_args=False)
    noise = _noise([trace.nodes[outcome]["fn"] for trace in traces])
    function = _Row(model, first, [*sizes.values()], outcome, noise is not None)
    simulator = SimulatorModel(
        function, noise=noise, batched=False, parameter_names=names
    )
    return PyroProblem(simulator, prior, names)


@dataclass(frozen=True)
class _Row:
    """A row of the simulator: the model, conditioned on parameters."""

    model: Callable[[Tensor], Any]
    sites: dict[str, Distribution]
    sizes: list[int]
    outcome: str
    is_mean: bool

    def __call__(self, theta: Any, action: Any, rng: np.random.Generator) -> Any:
        parts = torch.as_tensor(theta).split(self.sizes)
        data = {
            name: part.reshape(_shape(d))
            for (name, d), part in zip(self.sites.items(), parts, strict=True)
        }
        with forked_generators(int(rng.integers(2**62))), torch.no_grad():
            model = pyro.condition(self.model, data=data)
            trace: Any = poutine.trace(model).get_trace(torch.as_tensor(action).float())
        node = trace.nodes[self.outcome]
        return (node["fn"].mean if self.is_mean else node["value"]).reshape(-1).numpy()


def _latent(trace: Any, outcome: str) -> dict[str, Distribution]:
    return {
        name: node["fn"]
        for name, node in trace.nodes.items()
        if node["type"] == "sample"
        and not node["is_observed"]
        and name != outcome
        and not isinstance(node["fn"], _Subsample)
    }


def _noise(found: list[Any]) -> GaussianNoise | StudentTNoise | None:
    """Return the noise of an outcome of constant scale; None for any other."""
    first, *others = (_inner(d, "base_dist") for d in found)
    if not isinstance(first, (Normal, StudentT)):
        return None
    names = ("scale",) if isinstance(first, Normal) else ("scale", "df")
    for d in others:
        if type(d) is not type(first) or any(
            not torch.equal(getattr(d, name), getattr(first, name)) for name in names
        ):
            return None
    sd = first.scale.reshape(-1)
    sd = sd[0] if len(sd) > 1 and bool((sd == sd[0]).all()) else sd
    if isinstance(first, Normal):
        return GaussianNoise(sd)
    df = first.df.reshape(-1)
    if not bool((df == df[0]).all()) or df[0] <= 2:
        return None
    return StudentTNoise(sd * (df[0] / (df[0] - 2)).sqrt(), df[0])


def _inner(whole: Any, attribute: str) -> Any:
    """Return what a distribution or a support of vectors is made of."""
    while hasattr(whole, attribute) and not hasattr(whole, "transforms"):
        whole = getattr(whole, attribute)
    return whole


def _shape(d: Distribution) -> torch.Size:
    return d.batch_shape + d.event_shape


def _same(one: Any, other: Any) -> bool:
    """Return whether two distributions have the same density."""
    if type(one) is not type(other) or _shape(one) != _shape(other):
        return False
    draws = torch.stack([one.sample() for _ in range(3)])
    try:
        return bool(torch.equal(one.log_prob(draws), other.log_prob(draws)))
    except ValueError:  # a support that moves
        return False
