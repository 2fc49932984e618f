"""Actions as points of a unit cube and categories."""

from __future__ import annotations

import torch
from torch import Tensor

from sbi_active.actions import ActionSpace, BoxActions


class Coordinates:
    r"""Map actions to points :math:`z = (u, k)` and back.

    :math:`u \in [0, 1]^c` are the entries of the boxes, :math:`k` the index of the
    action of each part that lists its actions.

    Args:
        actions: The space.

    Attributes:
        num_continuous: c.
        sizes: Number of actions of each listed part.
        dim: Dimension of a point.

    Raises:
        TypeError: If a part is neither a box nor listed.

    Example:
        >>> from sbi_active import BoxActions, DiscreteActions, MixedActions
        >>> space = MixedActions(DiscreteActions([3.0, 7.0]), BoxActions(0.0, 2.0))
        >>> Coordinates(space).points(torch.tensor([[7.0, 0.5]]))
        tensor([[0.2500, 1.0000]], dtype=torch.float64)
    """

    def __init__(self, actions: ActionSpace) -> None:
        low, high = torch.full((2, actions.action_dim), torch.nan)
        self._lists: list[tuple[slice, Tensor]] = []
        for part, columns in actions.entries():
            values = part.listed()
            if values is not None:
                self._lists.append((columns, values))
            elif isinstance(part, BoxActions):
                low[columns], high[columns] = part.low, part.high
            else:
                raise TypeError(
                    f"expected boxes and lists of actions; got {type(part).__name__}; "
                    "use BoxActions, DiscreteActions or MixedActions of them"
                )
        self._boxed = low.isfinite()
        self._low, self._width = low, high - low
        self.num_continuous = int(self._boxed.sum())
        self.sizes = [len(values) for _, values in self._lists]
        self.dim = self.num_continuous + len(self.sizes)

    def points(self, action: Tensor) -> Tensor:
        """Return points, shape (n, dim), float64, of actions (n, action_dim)."""
        share = (action - self._low) / self._width
        parts = [share[:, self._boxed].double().clamp(0, 1)]
        for columns, values in self._lists:
            nearest = torch.cdist(action[:, columns].float(), values).argmin(1)
            parts.append(nearest.double()[:, None])
        return torch.cat(parts, 1)

    def actions(self, point: Tensor) -> Tensor:
        """Return actions, shape (n, action_dim), float32, of points (n, dim)."""
        action = self._low.repeat(len(point), 1).double()
        share = point[:, : self.num_continuous]
        action[:, self._boxed] += share * self._width[self._boxed]
        for k, (columns, values) in enumerate(self._lists, self.num_continuous):
            action[:, columns] = values[point[:, k].long()].double()
        return action.float()

    def distance(self, point: Tensor, other: Tensor) -> Tensor:
        """Return distances of points (n, dim) to one, infinite to other categories."""
        c = self.num_continuous
        apart = (point[:, :c] - other[:c]).square().sum(1).sqrt()
        same = (point[:, c:] == other[c:]).all(1)
        return apart.masked_fill(~same, torch.inf)

    def drawn(self, num: int, seed: int) -> Tensor:
        """Return points all over the space, shape (num, dim): scrambled Sobol."""
        engine = torch.quasirandom.SobolEngine(
            self.dim, scramble=True, seed=seed % 2**31
        )
        point = engine.draw(num, dtype=torch.float64)
        sizes = torch.tensor(self.sizes)
        point[:, self.num_continuous :].mul_(sizes).floor_()
        return point

    def filling(self, point: Tensor, num: int) -> Tensor:
        """Return the num points of (n, dim) that leave the smallest holes.

        Each is the farthest from those before it. The edge is half as far as it would
        be from a point: points stand off it by half of what lies between them.
        """
        inside = point[:, : self.num_continuous]
        room = 2 * torch.minimum(inside, 1 - inside).amin(1)
        chosen = []
        for _ in range(min(num, len(point))):
            chosen.append(int(room.argmax()))
            room = torch.minimum(room, self.distance(point, point[chosen[-1]]))
        return point[chosen]
