"""A list of actions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from sbi_active.actions.space import ActionSpace
from sbi_active.arrays import own_tensor
from sbi_active.expected import require
from sbi_active.seeding import forked_generators

#: What is taken for an action space: a list stands for its actions.
Actions: TypeAlias = (
    ActionSpace | Tensor | np.ndarray | Sequence[float] | Sequence[Sequence[float]]
)


class DiscreteActions(ActionSpace):
    r"""A finite set of actions :math:`\mathcal{D} = \{\xi_1, \ldots, \xi_a\}`.

    Args:
        values: Values of the actions, shape (a,) for scalar actions, or (a,
            action_dim).
        names: Names of the entries of the action.
        units: Units of the entries of the action.

    Raises:
        ValueError: If the set is empty, not finite, or has another shape.

    Example:
        >>> actions = DiscreteActions(torch.arange(-5, 5.5, 0.5))
        >>> actions.values.shape, actions.action_dim
        (torch.Size([21, 1]), 1)
    """

    def __init__(
        self,
        values: Tensor | np.ndarray | Sequence[float] | Sequence[Sequence[float]],
        *,
        names: Sequence[str] | None = None,
        units: Sequence[str] | None = None,
    ) -> None:
        tensor = own_tensor(values, torch.float32, name="actions")
        tensor = tensor[:, None] if tensor.ndim == 1 else tensor
        fits, got = tensor.ndim == 2 and tensor.numel() > 0, tuple(tensor.shape)
        expected = "actions of shape (a,) or (a, action_dim) with a >= 1"
        require(fits, expected, got, "give one row an action")
        is_finite = bool(tensor.isfinite().all())
        require(is_finite, "finite actions", tensor.tolist(), "remove NaN and inf")
        self.values = tensor
        self._label(names, units)

    def __len__(self) -> int:
        return len(self.values)

    def __repr__(self) -> str:
        return f"DiscreteActions({len(self)} x {', '.join(self.names)})"

    @property
    @override
    def action_dim(self) -> int:
        return self.values.shape[1]

    @override
    def sample(self, sample_shape: Sequence[int], *, seed: int | None = None) -> Tensor:
        with forked_generators(seed):
            index = torch.randint(len(self), torch.Size(sample_shape))
        return self.values[index]

    @override
    def contains(self, action: Tensor) -> Tensor:
        action = torch.as_tensor(action, dtype=torch.float32)
        near = torch.isclose(action[..., None, :], self.values, rtol=1e-5, atol=1e-7)
        return near.all(-1).any(-1)

    @override
    def listed(self) -> Tensor:
        return self.values


def action_space(actions: Any) -> ActionSpace:
    """Return an action space; a list, array or tensor stands for its actions.

    Raises:
        TypeError: If it is neither.
        ValueError: If :class:`DiscreteActions` refuses the list.
    """
    if isinstance(actions, ActionSpace):
        return actions
    if not isinstance(actions, list | tuple | range | Tensor | np.ndarray):
        raise TypeError(
            f"expected an action space or a list of actions; got {actions!r:.80}; pass "
            "DiscreteActions(values) or BoxActions(low, high)"
        )
    return DiscreteActions([*actions] if isinstance(actions, range) else actions)
