"""Draws that stand for a prior and actions that readers cannot load.

A class of a user's own is not stored with a campaign. Draws of it are, by which a
campaign can be shown, told and corrected where nobody runs the user's programs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints
from typing_extensions import override

from sbi_active.actions import ActionSpace
from sbi_active.campaign.state import CampaignState
from sbi_active.inference.beliefs.belief import Belief, ParticleDraws
from sbi_active.seeding import forked_generators

#: Draws of each. A choice: a quantile is off by some 2 % of the draws, half as many 3 %
#: and twice as many 1.5 %, and the file of ten parameters has 100 kB.
NUM_DRAWS = 500


def draws_of(thing: Distribution | ActionSpace, *, seed: int) -> dict[str, Any]:
    """Return as JSON what readers need of a prior or of an action space.

    Args:
        thing: Prior or action space.
        seed: Seed of the draws.
    """
    if isinstance(thing, ActionSpace):
        draws = thing.sample((NUM_DRAWS,), seed=seed)
        labels = {"names": [*thing.names], "units": [*thing.units]}
        return {"draws": draws.tolist(), **labels}
    with forked_generators(seed, "drawn"):
        draws = thing.sample(torch.Size([NUM_DRAWS])).reshape(NUM_DRAWS, -1)
    try:
        moments = thing.mean.reshape(-1), thing.variance.reshape(-1)
    except (AttributeError, NotImplementedError):
        moments = draws.mean(0), draws.var(0)
    mean, variance = (moment.tolist() for moment in moments)
    return {"draws": draws.tolist(), "mean": mean, "variance": variance}


def drawn_from(described: Mapping[str, Any]) -> DrawnPrior | DrawnActions:
    """Return what stands for the thing of :func:`draws_of`."""
    draws = torch.tensor(described["draws"])
    if "names" in described:
        return DrawnActions(draws, described["names"], described["units"])
    moments = (torch.tensor(described[name]) for name in ("mean", "variance"))
    return DrawnPrior(draws, *moments)


class DrawnPrior(ParticleDraws):
    """Stands for a prior, by its draws; it has no density.

    Args:
        draws: Draws, shape (n, theta_dim).
        mean: Mean, shape (theta_dim,).
        variance: Variance, shape (theta_dim,).
    """

    support = constraints.real_vector  # pyright: ignore

    def __init__(self, draws: Tensor, mean: Tensor, variance: Tensor) -> None:
        super().__init__(draws)
        self._moments = mean, variance

    @property
    @override
    def mean(self) -> Tensor:
        return self._moments[0]

    @property
    @override
    def variance(self) -> Tensor:
        return self._moments[1]

    @override
    def log_prob(self, value: Tensor) -> Tensor:
        raise ValueError(
            "expected the density of the campaign's prior, which only its author can "
            "make again; got draws alone; load the campaign with prior="
        )


class DrawnBelief(Belief):
    """Stands for a belief under such a prior, by the draws that a campaign keeps.

    Args:
        belief: Belief as it was read.
        prior: The prior.
        draws: Draws of the belief, shape (n, theta_dim).
    """

    def __init__(self, belief: Any, prior: DrawnPrior, draws: Tensor) -> None:
        super().__init__(getattr(belief, "prior", prior))
        for name in ("label", "parameter_names", "diagnostics"):
            setattr(self, name, getattr(belief, name, getattr(self, name)))
        self._draws = draws

    @override
    def _sample(self, num_samples: int) -> Tensor:
        return self._draws[torch.randint(len(self._draws), (num_samples,))]

    @override
    def _log_prob(self, theta: Tensor) -> Tensor:
        return self.prior.log_prob(theta)  # which there is not


class DrawnActions(ActionSpace):
    """Stands for an action space, by its draws; nobody knows what it contains.

    Args:
        draws: Draws, shape (n, action_dim).
        names: Names of the entries of the action.
        units: Units of the entries of the action.
    """

    def __init__(
        self, draws: Tensor, names: Sequence[str], units: Sequence[str]
    ) -> None:
        self._draws = draws
        self._label(names, units)

    @property
    @override
    def action_dim(self) -> int:
        return self._draws.shape[1]

    @override
    def sample(self, sample_shape: Sequence[int], *, seed: int | None = None) -> Tensor:
        with forked_generators(seed):
            picked = torch.randint(len(self._draws), torch.Size(sample_shape))
        return self._draws[picked]

    @override
    def contains(self, action: Tensor) -> Tensor:
        return torch.ones(action.shape[:-1]).bool()


def stood_for(
    belief: Distribution, prior: Distribution, state: CampaignState
) -> Distribution:
    """Return a belief that was read; its draws where there is no density of the prior.

    Args:
        belief: Belief as it was read.
        prior: Prior that the campaign began with.
        state: State of the campaign.
    """
    kept = [state.draws[i] for i in state.processed if i in state.draws]
    if not isinstance(prior, DrawnPrior) or not kept:
        return belief
    return DrawnBelief(belief, prior, kept[-1])
