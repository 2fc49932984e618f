"""Independent numbers of different distributions in one vector."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints
from typing_extensions import override

__all__ = ["Product"]


class Product(Distribution):
    r"""Prior :math:`p(\phi) = \prod_i p_i(\phi_i)` of numbers that are not alike.

    Args:
        parts: One a number, each of batch shape (1,).
    """

    arg_constraints: dict[str, Any] = {}  # pyright: ignore

    def __init__(self, parts: Sequence[Distribution]) -> None:
        self.parts = [*parts]
        super().__init__(torch.Size(), torch.Size([len(parts)]), validate_args=False)

    @property
    def support(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        """That of the parts."""
        each = [part.support for part in self.parts]
        lengths = [1] * len(each)
        return constraints.independent(
            constraints.cat(each, dim=-1, lengths=lengths), 1
        )

    @property
    @override
    def mean(self) -> Tensor:
        return torch.cat([part.mean for part in self.parts])

    @property
    @override
    def variance(self) -> Tensor:
        return torch.cat([part.variance for part in self.parts])

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """Return draws, shape (*sample_shape, d)."""
        shape = torch.Size(sample_shape)
        return torch.cat([part.sample(shape) for part in self.parts], -1)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return log densities, (..., d) -> (...)."""
        columns = value.unbind(-1)
        each = [
            part.log_prob(column[..., None])[..., 0]
            for part, column in zip(self.parts, columns, strict=True)
        ]
        return torch.stack(each).sum(0)
