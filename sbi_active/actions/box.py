"""Continuous actions within limits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from sbi_active.actions.space import ActionSpace
from sbi_active.arrays import own_tensor
from sbi_active.seeding import forked_generators


class BoxActions(ActionSpace):
    r"""All actions with :math:`l_j \le \xi_j \le h_j`.

    Args:
        low: l, a number or shape (action_dim,), in the units of the action.
        high: h, as ``low``.
        names: Names of the entries of the action.
        units: Units of the entries of the action.

    Attributes:
        leeway: Share of the width by which a float32 may leave the box.

    Raises:
        ValueError: If the limits differ in shape, are not finite, or leave no room.

    Example:
        >>> actions = BoxActions([0.0, -1.0], [2.0, 1.0], names=["speed", "angle"])
        >>> actions
        BoxActions(speed in [0, 2], angle in [-1, 1])
        >>> actions.contains(torch.tensor([[1.0, 0.5], [3.0, 0.5]]))
        tensor([ True, False])
    """

    leeway: ClassVar[float] = 1e-6

    def __init__(
        self,
        low: float | Tensor | np.ndarray | Sequence[float],
        high: float | Tensor | np.ndarray | Sequence[float],
        *,
        names: Sequence[str] | None = None,
        units: Sequence[str] | None = None,
    ) -> None:
        limits = [
            own_tensor(value, torch.float32, name=name)
            for name, value in (("low", low), ("high", high))
        ]
        self.low, self.high = (v[None] if v.ndim == 0 else v for v in limits)
        if self.low.ndim != 1 or self.low.shape != self.high.shape or not len(self.low):
            raise ValueError(
                "expected low and high of the same shape (action_dim,); got "
                f"{tuple(limits[0].shape)} and {tuple(limits[1].shape)}; give one "
                "limit each an entry of the action"
            )
        apart = (self.high > self.low) & (self.high - self.low).isfinite()
        if not bool(apart.all()):
            raise ValueError(
                f"expected finite low < high; got {self.low.tolist()} and "
                f"{self.high.tolist()}; pass the lower limit first, and leave out "
                "an entry that does not change"
            )
        self._label(names, units)

    def __repr__(self) -> str:
        rows = zip(self.names, self.low.tolist(), self.high.tolist(), strict=True)
        return f"BoxActions({', '.join(f'{n} in [{a:g}, {b:g}]' for n, a, b in rows)})"

    @property
    @override
    def action_dim(self) -> int:
        return len(self.low)

    @override
    def sample(self, sample_shape: Sequence[int], *, seed: int | None = None) -> Tensor:
        with forked_generators(seed):
            share = torch.rand(*sample_shape, self.action_dim)
        return self.low + share * (self.high - self.low)

    @override
    def contains(self, action: Tensor) -> Tensor:
        action = torch.as_tensor(action, dtype=torch.float32)
        slack = self.leeway * (self.high - self.low)
        return ((action >= self.low - slack) & (action <= self.high + slack)).all(-1)
