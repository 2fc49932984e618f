"""Support of a distribution's draws."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sbi.utils import MultipleIndependent
from torch import Tensor
from torch.distributions import (
    Distribution,
    Independent,
    MixtureSameFamily,
    TransformedDistribution,
    VonMises,
    constraints,
)
from torch.distributions.transforms import ComposeTransform

Array = NDArray[Any]


def support_of(distribution: Distribution) -> Any:
    """Return the support of a distribution's draws, as a torch constraint.

    It is the support that the distribution states, except where torch's is too large: a
    transformed distribution has the image of its base, not all that its last transform
    can reach; an angle lies between -pi and pi; components of a mixture have bounds
    each.
    """
    if isinstance(distribution, Independent):
        base = support_of(distribution.base_dist)
        return constraints.independent(base, distribution.reinterpreted_batch_ndims)
    if isinstance(distribution, MultipleIndependent):
        parts = [elementwise(support_of(part)) for part in distribution.dists]
        sizes = [int(size) for size in distribution.dims_per_dist]
        return constraints.independent(constraints.cat(parts, -1, sizes), 1)
    if isinstance(distribution, VonMises):
        return constraints.interval(-math.pi, math.pi)
    claimed: Any = distribution.support
    bounds = None
    if type(distribution) is TransformedDistribution:
        bounds = _image(distribution)
    elif isinstance(distribution, MixtureSameFamily):
        bounds = _bounds_of_components(distribution)
    if bounds is None:
        return claimed
    interval = constraints.interval(*bounds)
    return constraints.independent(interval, len(distribution.event_shape))


def within_support(distribution: Any, theta: Tensor) -> Tensor:
    """Return whether rows (n, theta_dim) lie in a distribution's support, shape (n,).

    If it has none, as a trained network, return whether their log density is finite.
    """
    try:
        inside = support_of(distribution).check(theta)
    except (NotImplementedError, AttributeError):
        return torch.isfinite(distribution.log_prob(theta))
    return inside.all(-1) if inside.shape == theta.shape else inside


def support_bounds(support: Any, dim: int) -> tuple[Array, Array]:
    """Return the bounds of each number of a torch constraint, shapes (dim,)."""
    if hasattr(support, "base_constraint"):
        return support_bounds(support.base_constraint, dim)
    if hasattr(support, "cseq"):  # constraints.cat
        parts = [
            support_bounds(part, int(length))
            for part, length in zip(support.cseq, support.lengths, strict=True)
        ]
        low, high = zip(*parts, strict=True)
        return np.concatenate(low), np.concatenate(high)
    bounds = []
    for name, missing in (("lower_bound", -np.inf), ("upper_bound", np.inf)):
        bound = torch.as_tensor(getattr(support, name, missing)).double().numpy()
        bounds.append(np.array(np.broadcast_to(bound.reshape(-1), (dim,))))
    return bounds[0], bounds[1]


def elementwise(support: Any) -> Any:
    """Return a constraint on single numbers, if it is one, which torch can join."""
    while support.event_dim > 0 and hasattr(support, "base_constraint"):
        support = support.base_constraint
    return support


def parts_of(support: Any) -> Iterator[Any]:
    """Yield the constraints that a support consists of."""
    if hasattr(support, "base_constraint"):
        yield from parts_of(support.base_constraint)
    elif hasattr(support, "cseq"):
        for part in support.cseq:
            yield from parts_of(part)
    else:
        yield support


def _image(distribution: TransformedDistribution) -> tuple[Tensor, Tensor] | None:
    """Return the bounds to which monotone transforms take those of the base."""
    if any(
        t.domain.event_dim or t.codomain.event_dim or not t.bijective
        for t in distribution.transforms
    ):
        return None
    base = distribution.base_dist
    shape = base.batch_shape + base.event_shape
    bounds = support_bounds(support_of(base), shape.numel())
    first, second = (torch.from_numpy(end).reshape(shape) for end in bounds)
    transform = ComposeTransform(distribution.transforms)
    first, second = (
        torch.as_tensor(transform(first)),
        torch.as_tensor(transform(second)),
    )
    low, high = torch.minimum(first, second), torch.maximum(first, second)
    if bool(low.isnan().any() | high.isnan().any()):  # the base leaves the domain
        return None
    # At an end a transform may have no inverse.
    low, high, far = low.float(), high.float(), torch.tensor(torch.inf)
    inner = low.nextafter(far), high.nextafter(-far)
    return low.where(low.isinf(), inner[0]), high.where(high.isinf(), inner[1])


def _bounds_of_components(mixture: MixtureSameFamily) -> tuple[Tensor, Tensor] | None:
    """Return the least and the largest bounds of a mixture's components."""
    parts = mixture.component_distribution
    shape = parts.batch_shape + parts.event_shape
    if mixture.batch_shape or any(
        isinstance(leaf, type(constraints.simplex)) or leaf.is_discrete
        for leaf in parts_of(parts.support)
    ):
        return None
    support = support_of(parts)
    low, high = (
        torch.from_numpy(end).reshape(shape)
        for end in support_bounds(support, shape.numel())
    )
    return low.amin(0), high.amax(0)


def parameter_dim(prior: Distribution) -> int:
    """Return the number of parameters, without drawing from the prior."""
    shape = prior.event_shape or prior.batch_shape
    return shape[-1] if shape else 1


def log_density(distribution: Any, theta: Tensor) -> Tensor:
    """Return the log density of rows, -inf outside the support.

    Otherwise a torch distribution that validates its arguments would raise there.

    Args:
        distribution: Anything with ``log_prob``.
        theta: Parameters, shape (n, theta_dim).

    Returns:
        Shape (n,), float64.
    """
    result = torch.full((len(theta),), -torch.inf, dtype=torch.float64)
    with torch.no_grad():
        inside = within_support(distribution, theta).reshape(len(theta), -1).all(-1)
        if bool(inside.any()):
            value = distribution.log_prob(theta[inside])
            if value.shape != (int(inside.sum()),):
                raise ValueError(
                    "expected one log density a row from a distribution over "
                    f"parameters; got shape {tuple(value.shape)} for "
                    f"{int(inside.sum())} rows; wrap it, as in "
                    "torch.distributions.Independent(distribution, 1)"
                )
            result[inside] = value.double()
    return result
