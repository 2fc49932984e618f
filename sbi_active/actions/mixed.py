"""Actions whose entries are of different kinds."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from typing_extensions import override

from sbi_active.actions.signals import SignalActions
from sbi_active.actions.space import ActionSpace
from sbi_active.seeding import derive_seed


class MixedActions(ActionSpace):
    r"""The product :math:`\mathcal D_1 \times \cdots \times \mathcal D_k` of spaces.

    An action is an action of each part, one behind the other. A part that lists its
    actions is taken as categorical by a search: that two of them are close in number
    says nothing about how much they tell.

    Args:
        *spaces: The parts, such as a box of speeds and a list of tools.

    Raises:
        ValueError: If there is no part.
        TypeError: If a part is not an action space.

    Example:
        >>> from sbi_active import BoxActions, DiscreteActions
        >>> actions = MixedActions(
        ...     BoxActions(0.0, 2.0, names=["speed"], units=["m/s"]),
        ...     DiscreteActions([0.0, 1.0, 2.0], names=["tool"]))
        >>> actions
        MixedActions(BoxActions(speed in [0, 2]) x DiscreteActions(3 x tool))
        >>> actions.names, actions.units
        (['speed', 'tool'], ['m/s', ''])
        >>> actions.sample((5,), seed=0).shape
        torch.Size([5, 2])
    """

    def __init__(self, *spaces: ActionSpace) -> None:
        strange = [s for s in spaces if not isinstance(s, ActionSpace)]
        if strange:
            raise TypeError(
                f"expected action spaces; got {type(strange[0]).__name__}; pass "
                "BoxActions(low, high) or DiscreteActions(values), one a part"
            )
        if not spaces:
            raise ValueError("expected one or more action spaces; got none; pass some")
        self._parts = [part for space in spaces for part in space.parts()]
        names = [name for part in self._parts for name in part.names]
        unique = len(set(names)) == len(names)
        units = [unit for part in self._parts for unit in part.units]
        self._label(names if unique else None, units)

    def __repr__(self) -> str:
        return f"MixedActions({' x '.join(map(repr, self._parts))})"

    @property
    @override
    def action_dim(self) -> int:
        return sum(part.action_dim for part in self._parts)

    @override
    def sample(self, sample_shape: Sequence[int], *, seed: int | None = None) -> Tensor:
        columns = []
        for i, part in enumerate(self._parts):
            own = None if seed is None else derive_seed(seed, "part", i)
            columns.append(part.sample(sample_shape, seed=own))
        return torch.cat(columns, -1)

    @override
    def contains(self, action: Tensor) -> Tensor:
        rows = torch.as_tensor(action)
        inside = [part.contains(rows[..., own]) for part, own in self.entries()]
        return torch.stack(inside).all(0)

    @override
    def permits(self, action: Tensor) -> Tensor:
        rows = torch.as_tensor(action)
        inside = [part.permits(rows[..., own]) for part, own in self.entries()]
        return torch.stack(inside).all(0)

    @property
    def input_times(self) -> Tensor:
        """Grid of the signals, s, shape (m,)."""
        return self._signals()[0].input_times

    def inputs(self, action: Tensor) -> dict[str, Tensor]:
        """Return the signals of the only part that has signals, by name.

        Args:
            action: Action of all parts, shape (n, action_dim) or (action_dim,).

        Raises:
            ValueError: If no part or several have signals.
        """
        space, entries = self._signals()
        return space.inputs(torch.as_tensor(action)[..., entries])

    def _signals(self) -> tuple[SignalActions, slice]:
        """Return the part that has signals, and its entries of an action."""
        every = self.entries()
        found = [(p, own) for p, own in every if isinstance(p, SignalActions)]
        if len(found) != 1:
            raise ValueError(
                f"expected one part of signals; got {len(found)} in {self}; join one "
                "SignalActions with what else is chosen"
            )
        return found[0]

    def listed(self) -> Tensor | None:
        """Return all combinations, the last part varying fastest."""
        values = [value for part in self._parts if (value := part.listed()) is not None]
        if len(values) < len(self._parts):
            return None
        places = torch.cartesian_prod(*(torch.arange(len(value)) for value in values))
        columns = places.reshape(-1, len(values)).unbind(1)
        return torch.cat([v[k] for v, k in zip(values, columns, strict=True)], 1)

    @override
    def parts(self) -> list[ActionSpace]:
        return [*self._parts]
