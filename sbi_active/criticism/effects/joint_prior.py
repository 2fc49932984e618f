"""The prior of an augmented simulator: theta and phi, independent."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints
from typing_extensions import override

from sbi_active.criticism.effects.effect import (
    Effect,
    log_density_within,
    require_distinct,
)
from sbi_active.expected import require
from sbi_active.support import elementwise, support_of


class JointPrior(Distribution):
    r"""Prior of the parameters and the effects,
    :math:`p(\theta, \phi) = p(\theta) \prod_e p_e(\phi_e)`.

    Args:
        prior: Prior of theta, event shape (theta_dim,); itself a joint prior where
            effects were added before.
        effects: Effects whose phi follow theta, in this order.
    """  # noqa: D205

    arg_constraints: dict[str, Any] = {}  # type: ignore[assignment]
    has_rsample = False

    def __init__(self, prior: Distribution, effects: Sequence[Effect]) -> None:
        if isinstance(prior, JointPrior):
            effects, prior = [*prior.effects, *effects], prior.prior
        require_distinct(effects)
        self.prior, self.effects = prior, [*effects]
        self.theta_dim = int(prior.event_shape.numel())
        self.sizes = [self.theta_dim, *[e.phi_dim for e in self.effects]]
        super().__init__(event_shape=torch.Size([sum(self.sizes)]), validate_args=False)

    @property
    @override
    def support(self) -> constraints.Constraint:  # type: ignore[override]
        parts = [elementwise(support_of(d)) for d in self._parts()]
        joint = [part for part in parts if part.event_dim > 0]
        expected = "priors whose numbers are bounded one by one"
        advice = "give parameters in coordinates without such a constraint"
        require(not joint, expected, f"supports {joint}", advice)
        return constraints.independent(
            constraints.cat(parts, dim=-1, lengths=self.sizes), 1
        )

    @property
    @override
    def mean(self) -> Tensor:
        return torch.cat([d.mean.reshape(-1) for d in self._parts()])

    @property
    @override
    def variance(self) -> Tensor:
        return torch.cat([d.variance.reshape(-1) for d in self._parts()])

    @override
    def sample(self, sample_shape: Any = ()) -> Tensor:
        shape = torch.Size(sample_shape)
        num = shape.numel()
        theta = self.prior.sample(torch.Size([num])).reshape(num, self.sizes[0])
        phi = [effect.sample(num).to(theta.dtype) for effect in self.effects]
        return torch.cat([theta, *phi], -1).reshape(*shape, sum(self.sizes))

    @override
    def log_prob(self, value: Tensor) -> Tensor:
        rows = value.reshape(-1, sum(self.sizes))
        theta, *phi = rows.split(self.sizes, -1)
        total = log_density_within(self.prior, theta)
        for effect, part in zip(self.effects, phi, strict=True):
            total = total + effect.log_prob(part).to(total.dtype)
        return total.reshape(value.shape[:-1])

    def _parts(self) -> list[Distribution]:
        return [self.prior, *[effect.prior for effect in self.effects]]


def joint_prior(prior: Distribution, effects: Sequence[Effect]) -> JointPrior:
    """Return the prior of theta and the effects' phi, never a posterior.

    Args:
        prior: Prior of theta, event shape (theta_dim,).
        effects: Effects, in the order of their parameters; those of scope "trial" are
            drawn by the simulator and are left out.

    Example:
        >>> from sbi.utils import BoxUniform
        >>> from torch.distributions import Normal
        >>> bias = Effect(
        ...     "bias", hook="observation", prior=Normal(0.0, 2.0), null=0.0,
        ...     apply=lambda x, phi, action, context: x + phi,
        ... )
        >>> joint = joint_prior(BoxUniform(torch.zeros(2), torch.ones(2)), [bias])
        >>> joint.sample((4,)).shape
        torch.Size([4, 3])
    """
    return JointPrior(prior, [e for e in effects if e.scope == "campaign"])
