"""Log densities of what users bring as a prior or a proposal."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sbi_active.support import support_of


def log_density(distribution: Any, theta: Tensor) -> Tensor:
    """Return the log density of rows, -inf outside the support.

    Otherwise a torch distribution that validates its arguments would raise outside of
    its support.

    Args:
        distribution: Anything with ``log_prob``.
        theta: Parameters, shape (n, theta_dim).

    Returns:
        Shape (n,), float64.
    """
    result = torch.full((len(theta),), -torch.inf, dtype=torch.float64)
    try:
        inside = support_of(distribution).check(theta)
    except (AttributeError, NotImplementedError):
        inside = torch.ones(len(theta), dtype=torch.bool)
    inside = inside.reshape(len(theta), -1).all(-1)
    if bool(inside.any()):
        with torch.no_grad():
            value = distribution.log_prob(theta[inside])
        if value.shape != (int(inside.sum()),):
            raise ValueError(
                "expected one log density a row from a distribution over parameters; "
                f"got shape {tuple(value.shape)} for {int(inside.sum())} rows; wrap "
                "it, as in torch.distributions.Independent(distribution, 1)"
            )
        result[inside] = value.double()
    return result
